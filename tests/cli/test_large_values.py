"""A file of options that is too much is refused in one short line."""

from __future__ import annotations

import pytest

from manip_il.cli.main import main

BOMB = "a: &a [x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{name}: &{name} [{', '.join(['*' + before] * 9)}]\n" for before, name in zip("abcdefgh", "bcdefghi", strict=True)
)


@pytest.mark.parametrize("command", ["dagger", "record", "quickstart"])
def test_a_bomb_as_a_file_of_options_is_one_short_line(tmp_path, command: str, capsys):
    (tmp_path / "bomb.yaml").write_text(BOMB)
    assert main([command, f"--config_path={tmp_path / 'bomb.yaml'}"]) == 2
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert len(error) < 1_000


@pytest.mark.parametrize(
    "text",
    [
        "dataset: [" + "1, " * 10_000 + "1]",
        "seed: " + "x" * 100_000,
        "cameras: {a: " + "y" * 100_000 + "}",
        "x" * 1_000 + ": 1",
    ],
)
def test_an_error_prints_of_a_large_value_as_much_as_one_reads(tmp_path, text: str, capsys):
    (tmp_path / "x.yaml").write_text(text)
    assert main(["record", f"--config_path={tmp_path / 'x.yaml'}"]) == 2
    assert len(capsys.readouterr().err) < 1_000
