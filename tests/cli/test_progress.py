from __future__ import annotations

import os
import pty
import subprocess
import sys

import pytest

from manip_il.cli.progress import progress, say, set_quiet, warn


@pytest.fixture(autouse=True)
def loud():
    set_quiet(False)
    yield
    set_quiet(False)


def test_short_work_prints_one_line_at_the_end(capsys):
    with progress(3, "record") as bar:
        for _ in range(3):
            bar.step(success=0.123456)
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("record: 3/3 (")
    assert "success 0.1235" in captured.err


def test_quiet_silences_progress_and_not_say(capsys):
    set_quiet(True)
    with progress(3, "record") as bar:
        bar.step()
    say("done")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("done\n", "")


def test_a_terminal_gets_a_bar_and_a_pipe_beside_it_gets_the_output():
    code = (
        "from manip_il.cli.progress import progress, say\n"
        "with progress(2, 'record') as bar:\n"
        "    bar.step(loss=0.5); say('result'); bar.step()"
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


def test_each_warning_is_one_line(capsys):
    warn("a joint has\nno range", "the other")
    warn()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["manip-il: warning: a joint has no range", "manip-il: warning: the other"]
