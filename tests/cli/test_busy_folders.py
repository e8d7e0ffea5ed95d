"""Of two commands at once on one output folder the second is refused, by the first one's process id."""

from __future__ import annotations

import os
from pathlib import Path

import pytest

from manip_il.cli.main import main
from manip_il.data.atomic import exclusive
from manip_il.errors import FolderBusyError

from .made_runs import make_eval

SAMPLE = Path(__file__).resolve().parents[2] / "datasets" / "sample"
STUDY = "common: {task.type: reach}\narms: {cloning: {method: cloning}, dagger: {}}\ntraining_seeds: 1\n"
COMMANDS = {
    "eval": ["--policy.type=expert", "--robot.type=fetch", "--task.type=reach", "--workers=1"],
    "dagger": [],
    "train": [f"--dataset.root={SAMPLE}", "--steps=1"],
    "compare": ["left.json", "right.json"],
    "merge": ["left.json", "right.json"],
    "study": ["study.yaml"],
    "certify": ["--robot.type=fetch", "--task.type=reach", "--workers=1"],
    "quickstart": [],
}


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    monkeypatch.chdir(tmp_path)
    make_eval(tmp_path / "left.json", [True, False])
    make_eval(tmp_path / "right.json", [False, False], seed=4_000_002)
    (tmp_path / "study.yaml").write_text(STUDY)
    return tmp_path


@pytest.mark.parametrize("how", ["", "--overwrite=true"])
@pytest.mark.parametrize("command", COMMANDS)
def test_a_folder_that_is_in_use_is_refused(command, how, here, capsys):
    if command == "compare":  # on the same episodes
        make_eval(here / "right.json", [False, False])
    out = here / "out"
    with exclusive(out):
        assert main([command, *COMMANDS[command], f"--output_dir={out}", *([how] if how else [])]) == 1
        errors = [line for line in capsys.readouterr().err.splitlines() if line.startswith("manip-il: error:")]
        assert errors == [
            f"manip-il: error: {out} is in use by process {os.getpid()}; wait until that is done, or choose another "
            "folder"
        ]
        assert not out.exists()


def test_where_nothing_may_be_written_beside_it_the_folder_itself_is_held(tmp_path, monkeypatch):
    folder = tmp_path / "volume"
    folder.mkdir()

    def refused(*_: object) -> int:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr("manip_il.data.atomic._lock", refused)
    with exclusive(folder):
        with pytest.raises(FolderBusyError), exclusive(folder):
            pass
        assert [path.name for path in tmp_path.iterdir()] == ["volume"]
        assert list(folder.iterdir()) == []
    with exclusive(folder):
        pass
    with pytest.raises(PermissionError), exclusive(tmp_path / "new"):
        pass
