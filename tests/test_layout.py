"""The repository keeps its own rules: who imports whom, what no file may name, what the lock pins."""

import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

from .conftest import IMPORTED_ONCE, LONG

ROOT = Path(__file__).resolve().parents[1]
BIN = Path(sys.executable).parent
LOCK = ROOT / "requirements.lock"

# Written in pieces, so that this file passes its own test.
REGISTRY = re.compile("|".join(["pypi" + r"\.org", "pythonhosted" + r"\.org", "index" + "-url"]))
MACHINE_PATH = re.compile(r"(?<![\w./~-])/(?:home|Users|root|work|mnt|data)" + r"/\w")
LEROBOT_DATASETS = {"data/lerobot_library.py"}


def tracked() -> list[Path]:
    """Files that git knows or would add."""
    command = ["git", "-c", "safe.directory=*", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in listing.split("\0") if name and (ROOT / name).is_file()]


def texts() -> Iterator[tuple[str, str]]:
    for path in tracked():
        try:
            yield str(path.relative_to(ROOT)), path.read_text(encoding="utf-8")
        except UnicodeDecodeError:  # pictures and other binaries
            continue


def sources() -> list[Path]:
    return sorted((ROOT / "manip_il").rglob("*.py"))


def imported(path: Path) -> set[str]:
    names: set[str] = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            names |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            names |= {node.module}
    return names


def requirement_blocks() -> list[str]:
    """The lock's entries, each with its continuation lines."""
    lines = [line for line in LOCK.read_text().splitlines() if line and not line.startswith("#")]
    return re.split(r"\n(?=\S)", "\n".join(lines))


def canonical(name: str) -> str:
    return re.sub(r"[-_.]+", "-", name).lower()


def test_modules_import_only_whom_they_may():
    done = subprocess.run([BIN / "lint-imports", "--no-cache"], cwd=ROOT, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stdout[done.stdout.find("Contracts") :] + done.stderr


def test_lerobots_dataset_code_stays_in_the_files_for_it():
    users = {
        str(path.relative_to(ROOT / "manip_il"))
        for path in sources()
        if any(re.match(r"lerobot\.datasets\b", name) for name in imported(path))
    }
    assert users == LEROBOT_DATASETS


@pytest.mark.parametrize(
    "module",
    ["intervals", "significance", "results", "report", "tables", "comparison", "study", "certificate"],
)
def test_reading_results_needs_neither_torch_nor_mujoco(module: str):
    code = f"import sys, manip_il.evaluation.{module}; print({{'torch', 'mujoco', 'lerobot'}} & set(sys.modules))"
    done = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "set()"


def test_no_file_names_a_registry_host():
    assert [name for name, text in texts() if REGISTRY.search(text)] == []


def test_no_file_names_a_path_of_one_machine():
    found = [(name, match.group()) for name, text in texts() if (match := MACHINE_PATH.search(text))]
    assert found == []


def test_there_is_one_lock():
    assert [path for path in tracked() if path.name == "uv.lock"] == []
    assert LOCK.is_file()


def test_the_lock_pins_every_requirement_with_hashes():
    blocks = requirement_blocks()
    assert len(blocks) > 50
    for block in blocks:
        assert re.match(r"[A-Za-z0-9._-]+==[^\s;]+", block), block.splitlines()[0]
        assert re.search(r"--hash=sha256:[0-9a-f]{64}", block), block.splitlines()[0]


def test_the_lock_holds_every_direct_dependency():
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    wanted = [*project["dependencies"], *project["optional-dependencies"]["dev"]]
    locked = {canonical(block.split("==")[0]) for block in requirement_blocks()}
    names = [canonical(match.group()) for text in wanted if (match := re.match(r"[A-Za-z0-9._-]+", text))]
    assert len(names) == len(wanted)
    assert [name for name in names if name not in locked] == []


def test_datasets_is_no_package():
    """A package of that name at the root would shadow Hugging Face's `datasets`."""
    assert not (ROOT / "datasets" / "__init__.py").exists()


def test_what_the_settings_of_the_tests_name_is_there():
    """A module or file that was moved would cost time alone, and be missed by nobody."""
    ours = [name for name in IMPORTED_ONCE if name.startswith("manip_il.")]
    assert [name for name in ours if find_spec(name) is None] == []
    assert [name for name in LONG if not (ROOT / "tests" / name).is_file()] == []
