from __future__ import annotations

import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from manip_il.cli import progress as module
from manip_il.cli.progress import Progress, say, say_policy, set_quiet, warn
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings


@pytest.fixture(autouse=True)
def loud():
    set_quiet(False)
    yield
    set_quiet(False)


def test_short_work_prints_one_line_at_the_end(capsys):
    with Progress(3, "record") as bar:
        for _ in range(3):
            bar.advance(success=0.123456)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("record: 3/3 (")
    assert "success 0.1235" in captured.err


def test_long_work_prints_a_line_an_interval_and_one_at_the_end(capsys, monkeypatch):
    now = [0.0]
    monkeypatch.setattr(module.time, "monotonic", lambda: now[0])
    with Progress(None, "train") as bar:
        for _ in range(20):
            now[0] += 1.0
            bar.advance(10)
    lines = capsys.readouterr().err.splitlines()
    assert lines == [f"train: {done} (10/s)" for done in (50, 100, 150, 200, 200)]


def test_work_that_fails_still_says_how_far_it_came(capsys):
    def work() -> None:
        with Progress(9, "record") as bar:
            bar.advance(2)
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        work()
    assert "record: 2/9" in capsys.readouterr().err


def test_quiet_silences_progress_and_not_say(capsys):
    set_quiet(True)
    with Progress(3, "record") as bar:
        bar.advance()
    say("done")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("done\n", "")


def test_a_terminal_gets_a_bar_and_a_pipe_beside_it_gets_the_output():
    code = (
        "from manip_il.cli.progress import Progress, say\n"
        "with Progress(2, 'record') as bar:\n"
        "    bar.advance(loss=0.5); say('result'); bar.advance()"
    )
    leader, follower = pty.openpty()
    env = {**os.environ, "TERM": "xterm", "COLUMNS": "100"}
    done = subprocess.run([sys.executable, "-c", code], stdout=subprocess.PIPE, stderr=follower, env=env, check=True)
    os.close(follower)
    shown = b""
    try:
        while chunk := os.read(leader, 65536):
            shown += chunk
    except OSError:  # how Linux reports the end of a terminal
        pass
    os.close(leader)
    assert done.stdout == b"result\n"
    assert b"2/2" in shown
    assert b"loss 0.5" in shown


@pytest.mark.parametrize(
    ("success", "lines"),
    [
        (True, ["best policy: runs/best", "next: manip-il eval"]),
        (
            False,
            [
                "DAgger round 2 fails in all 1 unseen episodes of panda reach: 0.0 % [0.0, 79.3]; "
                "its one failure ends in the phase approach.",
                "try in a new run: more --steps",
                "failures by phase, with films: manip-il eval",
            ],
        ),
    ],
)
def test_a_run_that_never_succeeded_says_what_to_try(success, lines, capsys):
    episode = EpisodeResult(0, success, success, 5, 0.0, phase_at_end="approach")
    found = EvalResult("DAgger round 2", "panda", "reach", {}, (episode,), EvalSettings(100, 0.02))
    say_policy(Path("runs/best"), found, "manip-il eval", "more --steps")
    assert capsys.readouterr().out.splitlines() == lines


def test_each_warning_is_one_line(capsys):
    warn("a joint has\nno range", "the other")
    warn()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["manip-il: warning: a joint has no range", "manip-il: warning: the other"]
