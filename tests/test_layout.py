"""The repository keeps its own rules: what no file may name, and what is named in several
places.
"""

import ast
import re
import subprocess
import tomllib
from importlib.util import find_spec
from pathlib import Path

import pytest
import yaml

from manip_il import __version__
from manip_il.sim.render import PACKAGES

from .conftest import IMPORTED_ONCE, LONG

ROOT = Path(__file__).resolve().parents[1]

# Written in pieces, so that this file passes its own test.
REGISTRY = re.compile("|".join(["pypi" + r"\.org", "pythonhosted" + r"\.org", "index" + "-url"]))
OF_A_CLONE = pytest.mark.skipif(not (ROOT / ".git").exists(), reason="git says what is ours")
MACHINE_PATH = re.compile(r"(?<![\w./~-])/(?:home|Users|root|work|mnt|data)" + r"/\w")


def tracked() -> list[Path]:
    """Files that git knows or would add."""
    command = [
        "git",
        "-c",
        "safe.directory=*",
        "ls-files",
        "-z",
        "--cached",
        "--others",
        "--exclude-standard",
    ]
    listing = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True).stdout
    return [ROOT / name for name in listing.split("\0") if name and (ROOT / name).is_file()]


def found(pattern: re.Pattern[str]) -> list[tuple[str, str]]:
    """Files that name something, and what.

    Not pictures and other binaries, as far as they are no text.
    """
    texts = (
        (path.relative_to(ROOT), path.read_text(encoding="utf-8", errors="ignore"))
        for path in tracked()
    )
    return [(str(path), match.group()) for path, text in texts if (match := pattern.search(text))]


@OF_A_CLONE
@pytest.mark.parametrize("pattern", [REGISTRY, MACHINE_PATH], ids=["registry", "machine"])
def test_no_file_names_a_registry_host_or_a_path_of_one_machine(pattern: re.Pattern[str]):
    assert found(pattern) == []


def test_what_the_settings_of_the_tests_name_is_there():
    """A module or file that was moved would cost time alone, and be missed by nobody."""
    ours = [name for name in IMPORTED_ONCE if name.startswith("manip_il.")]
    assert [name for name in ours if find_spec(name) is None] == []
    assert [name for name in LONG if not (ROOT / "tests" / name).is_file()] == []


@OF_A_CLONE
def test_every_file_that_the_package_reads_is_installed_in_it():
    """Not beside it, where it is missing after `pip install --target` or `--user`."""
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    folders = {
        ROOT.joinpath(*name.split(".")): globs for name, globs in settings["package-data"].items()
    }
    installed = {
        path for folder, globs in folders.items() for one in globs for path in folder.glob(one)
    }
    read = {
        path
        for path in tracked()
        if path.is_relative_to(ROOT / "manip_il") and path.suffix != ".py"
    }
    assert "data-files" not in settings
    assert read - installed == set()


def test_the_image_and_make_bring_the_packages_that_errors_name():
    assert PACKAGES in (ROOT / "Dockerfile").read_text()
    assert f"({PACKAGES})" in (ROOT / ".ci" / "system").read_text()


def test_the_version_is_the_same_wherever_it_is_written():
    projects = (
        tomllib.loads((ROOT / one / "pyproject.toml").read_text()) for one in (".", "plugin")
    )
    written = {one["project"]["version"] for one in projects}
    written.add(str(yaml.safe_load((ROOT / "CITATION.cff").read_text())["version"]))
    assert written == {__version__}
    assert f'image.version="{__version__}"' in (ROOT / "Dockerfile").read_text()
    assert f"\n## [{__version__}]" in (ROOT / "CHANGELOG.md").read_text()


def test_every_extra_that_an_error_or_a_page_names_can_be_installed():
    extras = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"][
        "optional-dependencies"
    ]
    pages = [*ROOT.glob("*.md"), *ROOT.glob("docs/*.md"), *ROOT.glob("manip_il/**/*.py")]
    named = {
        name
        for page in pages
        for names in re.findall(r"manip_il\[([\w,]+)\]", page.read_text(encoding="utf-8"))
        for name in names.split(",")
    }
    assert {"ray", "rl", "serve", "sharing", "view"} <= named <= extras.keys()
    everything = re.findall(r"\w+", extras["all"][0].partition("[")[2])
    assert {*everything, "all", "dev"} == extras.keys()


def calls(*names: str) -> set[tuple[str, str, str]]:
    """File, function and callee of every call in the package of functions with these names, or
    methods `.names`.
    """
    found = set[tuple[str, str, str]]()
    for path in sorted((ROOT / "manip_il").rglob("*.py")):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for function in (node for node in ast.walk(tree) if isinstance(node, ast.FunctionDef)):
            for call in (node for node in ast.walk(function) if isinstance(node, ast.Call)):
                name = ast.unparse(call.func)
                literal = bool(call.args) and isinstance(call.args[0], ast.Constant)
                if (name in names or f".{name.rpartition('.')[2]}" in names) and not literal:
                    found.add((path.relative_to(ROOT / "manip_il").as_posix(), function.name, name))
    return found


def test_one_function_runs_a_users_file_and_one_place_calls_it():
    files = (
        ".exec_module",
        ".spec_from_file_location",
        ".run_path",
        ".run_module",
        "exec",
        "__import__",
        "execfile",
    )
    assert {(file, function) for file, function, _ in calls(*files)} == {
        ("own_file.py", "own_class")
    }
    assert calls("own_class") == {
        ("tasks/table.py", "_of_file", "own_class"),
        ("worlds/gym/environment.py", "own_kind", "own_class"),
    }


def test_other_code_is_found_by_the_packages_own_tables_alone():
    assert {
        (file, function) for file, function, _ in calls("import_module", ".import_module", "eval")
    } == {
        ("__init__.py", "__getattr__"),
        ("algorithms/run.py", "results"),
        ("cli/main.py", "load"),
        ("cli/main.py", "run"),
        ("learn/lerobot_config.py", "policy_types"),
        ("bridges/mcap/importing.py", "read_messages"),
        ("option.py", "type_of"),
        ("sim/render.py", "_context"),
        ("worlds/table.py", "_kind_of"),
    }


def test_a_text_becomes_a_path_only_where_a_person_typed_it():
    assert {(file, function) for file, function, _ in calls("typed")} == {
        ("cli/parsing.py", "decode"),
        ("lerobot_plugin/environment.py", "_given"),
        ("worlds/table.py", "make_config"),
    }
    assert {(file, function) for file, function, _ in calls("make_config")} == {
        ("evaluation/robot_check.py", "check_robot"),  # of the robot on the command line
        ("worlds/table.py", "env_of_name"),  # written in Python
        ("worlds/ladder/world.py", "make_env"),
    }
