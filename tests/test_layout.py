"""The repository keeps its own rules: what no file may name, and what is named in several places."""

import re
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from manip_il.sim.render import PACKAGES

from .conftest import IMPORTED_ONCE, LONG

ROOT = Path(__file__).resolve().parents[1]

# Written in pieces, so that this file passes its own test.
REGISTRY = re.compile("|".join(["pypi" + r"\.org", "pythonhosted" + r"\.org", "index" + "-url"]))
MACHINE_PATH = re.compile(r"(?<![\w./~-])/(?:home|Users|root|work|mnt|data)" + r"/\w")


def tracked() -> list[Path]:
    """Files that git knows or would add."""
    command = ["git", "-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in listing.split("\0") if name and (ROOT / name).is_file()]


def found(pattern: re.Pattern[str]) -> list[tuple[str, str]]:
    """Files that name something, and what; not pictures and other binaries, as far as they are no text."""
    texts = ((path.relative_to(ROOT), path.read_text(encoding="utf-8", errors="ignore")) for path in tracked())
    return [(str(path), match.group()) for path, text in texts if (match := pattern.search(text))]


@pytest.mark.parametrize("pattern", [REGISTRY, MACHINE_PATH], ids=["registry", "machine"])
def test_no_file_names_a_registry_host_or_a_path_of_one_machine(pattern: re.Pattern[str]):
    assert found(pattern) == []


def test_what_the_settings_of_the_tests_name_is_there():
    """A module or file that was moved would cost time alone, and be missed by nobody."""
    ours = [name for name in IMPORTED_ONCE if name.startswith("manip_il.")]
    assert [name for name in ours if find_spec(name) is None] == []
    assert [name for name in LONG if not (ROOT / "tests" / name).is_file()] == []


def test_every_file_that_the_package_reads_is_installed_in_it():
    """Not beside it, where it is missing after `pip install --target` or `--user`."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {ROOT.joinpath(*name.split(".")): globs for name, globs in settings["package-data"].items()}
    installed = {path for folder, globs in folders.items() for one in globs for path in folder.glob(one)}
    read = {path for path in tracked() if path.is_relative_to(ROOT / "manip_il") and path.suffix != ".py"}
    assert "data-files" not in settings
    assert read - installed == set()


def test_the_image_and_make_bring_the_packages_that_errors_name():
    assert PACKAGES in (ROOT / "Dockerfile").read_text()
    assert f"({PACKAGES})" in (ROOT / ".ci" / "system").read_text()
