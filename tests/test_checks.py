"""What is read from outside has its declared type afterwards, or is refused in one short line."""

import os
import time
from itertools import pairwise
from pathlib import Path

import pytest

from manip_il import checks
from manip_il.bridges.mcap.importing import read_messages
from manip_il.bridges.store.manifest import File
from manip_il.data.atomic import read_lines
from manip_il.data.camera import open_video
from manip_il.data.journal import read_journal
from manip_il.data.parquet_files import count_rows, read_file
from manip_il.errors import ManipError, UsageError
from manip_il.learn.network import read_weights
from manip_il.robots.robot import ModelFiles


@pytest.mark.parametrize(
    "value", ["", ".", "..", ".hidden", "a..b", "../a", "a\\b", "a\n", "a\0", "~", "é", "a" * 101]
)
def test_names_that_could_leave_a_folder_are_refused(value):
    for check, refused in (
        (checks.name, value),
        (checks.name, "a/b"),
        (checks.repo_id, f"a/{value}"),
    ):
        with pytest.raises(ManipError, match="camera is"):
            check("camera", refused)
    with pytest.raises(ManipError):
        checks.repo_id("repo id", "a/b/c")
    assert checks.repo_id("repo id", "user/so-101_v1.2") == "user/so-101_v1.2"


def test_a_json_file_is_read_with_none_for_what_is_no_number(tmp_path):
    path = tmp_path / "x.json"
    path.write_text('{"a": 1000}')
    assert checks.read_json(path, "an x") == {"a": 1000}
    assert checks.parse_json("an x", "[NaN, -Infinity]") == [None, None]


def test_a_child_process_is_bounded_and_its_refusal_comes_home():
    checks.in_child("a number", checks.whole, "n", 3, 0, 5)
    with pytest.raises(ManipError, match="n is 7; expected a whole number from 0 to 5"):
        checks.in_child("a number", checks.whole, "n", 7, 0, 5)
    limits = r"x\.xml cannot be opened in 4 GB of memory and 120 s: "
    with pytest.raises(ManipError, match=f"{limits}out of memory"):
        checks.in_child("x.xml", bytearray, 2 * checks.MEMORY_IN_CHILD)
    with pytest.raises(ManipError, match=f"{limits}-6"):
        checks.in_child("x.xml", os.abort)
    with pytest.raises(ManipError, match=r"in 4 GB of memory and 0\.5 s: out of time"):
        checks.in_child("x.xml", time.sleep, 30, seconds=0.5)


def hide(path: Path, kind: str) -> None:
    path.unlink(missing_ok=True)
    os.mkfifo(path) if kind == "pipe" else path.symlink_to("/dev/zero")


@pytest.mark.parametrize("kind", ["pipe", "device"])
@pytest.mark.parametrize(
    "read",
    [
        lambda path: checks.read_json(path, "an x"),
        lambda path: checks.read_yaml(path, "an x"),
        read_lines,
        read_journal,
        lambda path: list(read_messages(path, ["/a"])),
        open_video,
        lambda path: read_file(path, ["x"]),
        count_rows,
        lambda path: File.of(path),
    ],
)
def test_what_is_not_a_regular_file_is_refused_in_a_line_by_every_reader(
    read, kind: str, tmp_path: Path
):
    hide(tmp_path / "x", kind)
    with pytest.raises(ManipError, match=r"cannot read .*/x: it is not a regular file") as error:
        read(tmp_path / "x")
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("kind", ["pipe", "device"])
def test_so_are_a_models_included_files_and_a_policys_weights(kind: str, tmp_path: Path):
    (tmp_path / "a.xml").write_text("<mujoco><include file='b.xml'/></mujoco>")
    (tmp_path / "b.xml").write_text('<mujoco><include file="c.xml"/></mujoco>')
    hide(tmp_path / "c.xml", kind)
    with pytest.raises(UsageError, match=r"c\.xml: it is not a regular file; expected an MJCF"):
        ModelFiles(tmp_path / "a.xml").load("arm")
    hide(tmp_path / "model.safetensors", kind)
    with pytest.raises(ManipError, match="it is not a regular file; expected weights"):
        read_weights(tmp_path)


def test_yaml_is_bounded_in_what_it_expands_to_and_holds_unicode(tmp_path: Path):
    rows = ["a: &a [x, x, x, x, x, x, x, x, x]"]
    rows += [
        f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]"
        for before, name in pairwise("abcdefghi")
    ]
    for text in ("\n".join(rows), "&a [*a]", "&a {k: *a}"):
        with pytest.raises(ValueError, match="more than 100,000 values"):
            checks.parse_yaml(text)
    assert checks.parse_yaml("a: &a {k: 1}\nb: {<<: *a, l: [*a, *a]}")["b"] == {
        "k": 1,
        "l": [{"k": 1}] * 2,
    }
    with pytest.raises(ValueError, match="surrogates not allowed"):
        checks.parse_yaml('names: ["\\ud800"]')
    with pytest.raises(ManipError, match="in Unicode"):
        checks.text("task", "\ud800")


@pytest.mark.parametrize(
    "text", ["a: !!python/object/apply:os.getcwd []", "2001-99-99", "a: [", "\0", b"a: \xff"]
)
def test_what_is_no_sound_yaml_is_refused_in_a_line(tmp_path: Path, text: str | bytes):
    path = tmp_path / "c.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UsageError, match="is not YAML") as error:
        checks.read_yaml(path, "a YAML file of options")
    assert "\n" not in str(error.value)
    path.write_text("a: [1, 2.5, yes, null, '*b']")
    assert checks.read_yaml(path, "a YAML file") == {"a": [1, 2.5, True, None, "*b"]}
