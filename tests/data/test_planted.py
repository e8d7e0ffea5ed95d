"""What is planted under the name of a file of ours: a link leads to no other file."""

from collections.abc import Callable
from pathlib import Path

import pytest

from manip_il.data.atomic import append_line
from manip_il.errors import ManipError
from manip_il.learn.training_state import json_lines

HELD = b"of the user\n"


def write_metrics(folder: Path) -> None:
    write = json_lines(folder / "metrics.jsonl", 0)
    (folder / "metrics.jsonl").unlink()
    (folder / "planted").rename(folder / "metrics.jsonl")
    write({"step": 1})


WRITERS: dict[str, Callable[[Path], None]] = {
    "records.jsonl": lambda folder: append_line(folder / "records.jsonl", {"a": 1}),
    "planted": write_metrics,
}


@pytest.mark.parametrize("name", WRITERS)
@pytest.mark.parametrize("kind", ["a link", "a link to nothing"])
def test_nothing_is_written_through_what_is_planted(tmp_path: Path, name: str, kind: str):
    victim, folder = tmp_path / "victim", tmp_path / "folder"
    folder.mkdir()
    if kind == "a link":
        victim.write_bytes(HELD)
    (folder / name).symlink_to(victim)
    with pytest.raises((OSError, ManipError), match="symbolic link"):
        WRITERS[name](folder)
    assert victim.exists() == (kind == "a link")
    assert kind != "a link" or victim.read_bytes() == HELD
