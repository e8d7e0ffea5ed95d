"""The repository keeps its own rules: who imports whom, what no file may name, what the lock pins."""

import re
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest

from .conftest import IMPORTED_ONCE, LONG

ROOT = Path(__file__).resolve().parents[1]
LOCK = ROOT / "requirements.lock"

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


def requirement_blocks() -> list[str]:
    """The lock's entries, each with its continuation lines."""
    lines = [line for line in LOCK.read_text().splitlines() if line and not line.startswith("#")]
    return re.split(r"\n(?=\S)", "\n".join(lines))


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_lerobots_dataset_code_is_not_called():
    package = ROOT / "manip_il"
    imports = re.compile(r"^\s*(from|import) lerobot\.datasets\b|^\s*from lerobot import .*\bdatasets\b", re.MULTILINE)
    users = {path for path in package.rglob("*.py") if imports.search(path.read_text(encoding="utf-8"))}
    assert users == set()


@pytest.mark.parametrize("pattern", [REGISTRY, MACHINE_PATH], ids=["registry", "machine"])
def test_no_file_names_a_registry_host_or_a_path_of_one_machine(pattern: re.Pattern[str]):
    assert found(pattern) == []


def test_the_lock_pins_every_requirement_with_hashes():
    blocks = requirement_blocks()
    assert len(blocks) > 50
    pinned = re.compile(r"[A-Za-z0-9._-]+==[^\s;]+(?s:.*)--hash=sha256:[0-9a-f]{64}")
    assert [block.splitlines()[0] for block in blocks if not pinned.match(block)] == []


def test_the_lock_holds_every_direct_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    locked = {canonical(block.split("==")[0]) for block in requirement_blocks()}
    names = [canonical(match.group()) for text in wanted if (match := re.match(r"[A-Za-z0-9._-]+", text))]
    assert len(names) == len(wanted)
    assert [name for name in names if name not in locked] == []


def test_what_the_settings_of_the_tests_name_is_there():
    """A module or file that was moved would cost time alone, and be missed by nobody."""
    ours = [name for name in IMPORTED_ONCE if name.startswith("manip_il.")]
    assert [name for name in ours if find_spec(name) is None] == []
    assert [name for name in LONG if not (ROOT / "tests" / name).is_file()] == []
