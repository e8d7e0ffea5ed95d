"""What is read from outside has its declared type afterwards, or is refused in one short line."""

import os
import time
from pathlib import Path

import pytest

from manip_il import checks
from manip_il.errors import ManipError, UsageError


@pytest.mark.parametrize("value", ["", ".", "..", ".hidden", "a..b", "../a", "a\\b", "a\n", "a\0", "~", "é", "a" * 101])
def test_names_that_could_leave_a_folder_are_refused(value):
    for check, refused in ((checks.name, value), (checks.name, "a/b"), (checks.repo_id, f"a/{value}")):
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


@pytest.mark.parametrize("text", ["a: !!python/object/apply:os.getcwd []", "2001-99-99", "a: [", "\0", b"a: \xff"])
def test_what_is_no_sound_yaml_is_refused_in_a_line(tmp_path: Path, text: str | bytes):
    path = tmp_path / "c.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UsageError, match="is not YAML") as error:
        checks.read_yaml(path, "a YAML file of options")
    assert "\n" not in str(error.value)
    path.write_text("a: [1, 2.5, yes, null, '*b']")
    assert checks.read_yaml(path, "a YAML file") == {"a": [1, 2.5, True, None, "*b"]}
