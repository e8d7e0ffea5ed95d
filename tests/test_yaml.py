"""YAML that somebody made to do harm, or just wrong: refused in one short line, at once."""

from __future__ import annotations

import pytest

from manip_il.checks import DEEPEST_YAML, LARGEST_YAML, parse_yaml, read_yaml
from manip_il.errors import UsageError

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "\n".join(
    f"{name}: &{name} [{', '.join([f'*{before}'] * 9)}]" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize(
    "text",
    [
        BOMB,
        "&a [*a]",
        "[" * 100_000,
        "[" * (DEEPEST_YAML + 1) + "]" * (DEEPEST_YAML + 1),
        "a: !!python/object/apply:os.getcwd []",
        "2001-99-99",
        "!!timestamp x",
        "!!int ''",
        "9" * 5_000,
        "0x" + "f" * 5_000,
        "a: " + "59:" * 5_000 + "59",
        "a: [",
        "\0",
        b"a: \xff",
    ],
)
def test_what_is_no_sound_yaml_is_refused_in_a_line(tmp_path, text):
    path = tmp_path / "c.yaml"
    path.write_bytes(text if isinstance(text, bytes) else text.encode())
    with pytest.raises(UsageError, match="is not YAML") as error:
        read_yaml(path, "a YAML file of options")
    assert len(str(error.value)) < len(str(path)) + 400
    assert "\n" not in str(error.value)


def test_a_file_that_takes_minutes_to_parse_is_refused_unread(tmp_path):
    path = tmp_path / "c.yaml"
    path.write_text("a: 1\n" * LARGEST_YAML)
    with pytest.raises(UsageError, match=f"has more than {LARGEST_YAML} bytes"):
        read_yaml(path, "a YAML file of options")


def test_plain_yaml_is_read():
    assert parse_yaml("a: [1, 2.5, yes, null, '*b']\nb: {c: d & e}") == {
        "a": [1, 2.5, True, None, "*b"],
        "b": {"c": "d & e"},
    }
    deep = "[" * (DEEPEST_YAML - 1) + "]" * (DEEPEST_YAML - 1)
    assert isinstance(parse_yaml(deep), list)
