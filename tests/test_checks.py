"""What is read from outside has its declared type afterwards, or is refused in one short line."""

import json
import os
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il import checks
from manip_il.errors import ManipError, UsageError

ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner) | st.dictionaries(st.text(), inner),
    max_leaves=20,
)
CHECKS = {
    "name": (lambda value: checks.name("it", value), str),
    "repo id": (lambda value: checks.repo_id("it", value), str),
    "text": (lambda value: checks.text("it", value, 50), str),
    "truth": (lambda value: checks.truth("it", value), bool),
    "whole": (lambda value: checks.whole("it", value, 0, 10), int),
    "number": (lambda value: checks.number("it", value, -1.0, 1.0), float),
    "array": (lambda value: checks.array("it", value, 3), list),
    "mapping": (lambda value: checks.mapping("it", value), dict),
}


@pytest.mark.parametrize("check", CHECKS)
@given(value=ANYTHING)
def test_a_value_has_its_type_or_is_refused_in_one_short_line(check, value):
    function, kind = CHECKS[check]
    try:
        checked = function(value)
    except ManipError as error:
        message = str(error)
    else:
        assert type(checked) is kind
        return
    assert message.startswith("it is ")
    assert "expected" in message
    assert len(message) < 500


@pytest.mark.parametrize(
    "value", ["", ".", "..", ".hidden", "a..b", "../a", "a/b", "a\\b", "a\n", "a\0", "~", "é", "a" * 101, None, 3]
)
def test_names_that_could_leave_a_folder_are_refused(value):
    with pytest.raises(ManipError, match="camera is"):
        checks.name("camera", value)


@pytest.mark.parametrize("value", ["front", "wrist_2", "so-101", "v1.2", "_"])
def test_plain_names_are_taken(value):
    assert checks.name("camera", value) == value


@pytest.mark.parametrize("value", ["../a", "a/../b", "a/b/c", "/a", "a/", "~/x", 3])
def test_repo_ids_have_one_or_two_plain_parts(value):
    with pytest.raises(ManipError):
        checks.repo_id("repo id", value)
    assert checks.repo_id("repo id", "user/name") == "user/name"


@pytest.mark.parametrize(
    "text",
    ["[" * 100_000, '{"a": NaN}', "9" * 5_000, "{", "", b"\xff"],
    ids=["deep", "nan", "long", "cut", "empty", "utf"],
)
def test_json_that_is_none_is_refused_in_one_line(text):
    with pytest.raises(ManipError, match="f is not valid JSON"):
        checks.parse_json("f", text)


def test_a_file_larger_than_allowed_is_refused(tmp_path):
    path = tmp_path / "x.json"
    path.write_text(json.dumps({"a": "b" * 100}))
    assert checks.read_json(path, "an x") == {"a": "b" * 100}
    with pytest.raises(ManipError, match="more than 20 bytes"):
        checks.read_json(path, "an x", largest=20)


def test_a_huge_value_is_printed_short():
    assert len(checks.shorten([["a" * 1_000] * 1_000] * 1_000)) <= 300
    assert len(checks.shorten(10**4_000)) < 200
    assert checks.shorten(10**5_000) == "a huge int"


def test_what_is_no_regular_file_is_neither_read_nor_written(tmp_path: Path):
    os.mkfifo(tmp_path / "pipe")
    (tmp_path / "mine").write_text("kept")
    (tmp_path / "link").symlink_to(tmp_path / "mine")
    for path, flags in ((tmp_path / "pipe", os.O_RDONLY), (Path("/dev/zero"), os.O_RDONLY), (tmp_path, os.O_RDONLY)):
        with pytest.raises(OSError, match="not a regular file"):
            checks.open_regular(path, flags)
    for name in ("link", "pipe"):
        with pytest.raises(OSError, match="not a regular file"):
            checks.open_regular(tmp_path / name, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
    assert (tmp_path / "mine").read_text() == "kept"
    os.close(checks.open_regular(tmp_path / "link"))  # reading through a link is as ever
    with pytest.raises(ManipError, match="pipe: not a regular file"):
        checks.read_bytes(tmp_path / "pipe", "a file", 10)


def test_a_child_process_is_bounded_and_its_refusal_comes_home(monkeypatch: pytest.MonkeyPatch):
    checks.in_child("a number", checks.whole, "n", 3, 0, 5)
    with pytest.raises(ManipError, match="n is 7; expected a whole number from 0 to 5"):
        checks.in_child("a number", checks.whole, "n", 7, 0, 5)
    limits = r"x\.xml cannot be opened in 4 GB of memory and 120 s: "
    with pytest.raises(ManipError, match=f"{limits}out of memory"):
        checks.in_child("x.xml", bytearray, 2 * checks.MEMORY_IN_CHILD)
    with pytest.raises(ManipError, match=f"{limits}-6"):
        checks.in_child("x.xml", os.abort)
    monkeypatch.setattr(checks, "SECONDS_IN_CHILD", 0.5)
    with pytest.raises(ManipError, match=r"in 4 GB of memory and 0\.5 s: out of time"):
        checks.in_child("x.xml", time.sleep, 30)


@pytest.mark.parametrize(
    "text",
    ["a: !!python/object/apply:os.getcwd []", "2001-99-99", "9" * 5_000, "a: [", "\0", b"a: \xff", "[" * 100_000],
)
def test_what_is_no_sound_yaml_is_refused_in_a_line(tmp_path: Path, text: str | bytes):
    path = tmp_path / "c.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UsageError, match="is not YAML") as error:
        checks.read_yaml(path, "a YAML file of options")
    assert len(str(error.value)) < 1_500
    assert "\n" not in str(error.value)
    path.write_text("a: [1, 2.5, yes, null, '*b']")
    assert checks.read_yaml(path, "a YAML file") == {"a": [1, 2.5, True, None, "*b"]}
