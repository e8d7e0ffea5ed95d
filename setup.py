"""What an index shows of the package: links, and the README with its pictures.

They need an absolute address, which is the publisher's to give: `make dist PUBLISHER=https://HOST/OWNER/NAME`.
"""

import os
import re
import tomllib
from pathlib import Path

from setuptools import setup

ROOT = Path(__file__).parent
publisher = os.environ.get("PUBLISHER", "").rstrip("/")
readme = (ROOT / "README.md").read_text(encoding="utf-8")
links = {}
if publisher:
    tag = "v" + tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["version"]
    for start, folder in ((r"(!\[[^\]]*\]\()", "raw"), (r"((?<!!)\[[^\]]*\]\()", "blob")):
        readme = re.sub(rf"{start}(?!https:|#)", rf"\1{publisher}/{folder}/{tag}/", readme)
    links = {
        "Source": publisher,
        "Documentation": f"{publisher}/blob/{tag}/docs/README.md",
        "Changelog": f"{publisher}/blob/{tag}/CHANGELOG.md",
    }
setup(
    long_description=readme,
    long_description_content_type="text/markdown",
    project_urls=links,
)
