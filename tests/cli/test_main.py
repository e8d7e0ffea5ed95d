import re
import subprocess
import sys

import pytest

from manip_il.cli.main import COMMANDS, main

from . import fake_command
from .made_runs import run


@pytest.fixture(autouse=True)
def fake(monkeypatch):
    for package in ("manip_il.cli", "manip_il.cli.run"):
        monkeypatch.setitem(sys.modules, f"{package}.fake_command", fake_command)
    monkeypatch.setitem(COMMANDS, "fake", ("fake_command:FakeOptions", "do what the tests ask"))


def test_the_module_runs_as_a_program():
    run = [sys.executable, "-m", "manip_il.cli.main"]
    done = subprocess.run([*run, "recrod"], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith(
        "manip-il: error: unknown command 'recrod' (did you mean 'record'?); known: "
    )
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("words", "code", "line"),
    [
        (["fake", "--act=fail"], 1, "manip-il: error: the work failed"),
        (["fake", "--act=usage"], 2, "manip-il: error: 0 episodes; expected 1 or more"),
        (
            ["fake", "--act=bug"],
            1,
            "manip-il: error: ZeroDivisionError: by zero; run again with --debug for the traceback",
        ),
        (
            ["fake", "--act=stop"],
            130,
            (
                "\nstopping after the current step (press Ctrl-C again to stop at once)\n"
                "manip-il: interrupted; kept: 1 of 50 episodes in x; continue with --resume=true"
            ),
        ),
        (
            ["fake", "--act=interrupt"],
            130,
            "manip-il: interrupted",
        ),
        (
            ["fake", "--dataset.num_episods=1"],
            2,
            (
                "manip-il: error: unknown option '--dataset.num_episods' "
                "(did you mean '--dataset.num_episodes'?); "
                "--help lists all"
            ),
        ),
    ],
)
def test_every_error_is_one_line_and_an_exit_code(words, code, line, capfd):
    assert main(words) == code
    assert capfd.readouterr() == ("", line + "\n")


@pytest.mark.parametrize("words", [["fake", "--help"], ["fake", "-h"]])
def test_help_holds_options_defaults_and_an_example(words, capsys):
    assert main(words) == 0
    out = capsys.readouterr().out
    assert (
        "usage: manip-il fake [--option=value ...]\n\nDo what the tests ask.\n\nAnd say so.\n"
        in out
    )
    assert re.search(r"--dataset.num_episodes=INT +how many episodes \[50\]\n", out)
    assert "--dataset.root=PATH" in out
    assert "example: manip-il fake --act=say" in out


def test_words_behind_two_dashes_are_another_programs(capsys):
    assert run("serve --speed=0 -- lerobot-record --help --debug") == 2
    assert capsys.readouterr().err == "manip-il: error: --speed is 0.0; expected 0.1 to 10\n"


@pytest.mark.parametrize(
    "words", [["--debug", "fake", "--act=bug"], ["fake", "--act=bug", "--debug"]]
)
def test_debug_shows_the_traceback(words, capsys):
    assert main(words) == 1
    err = capsys.readouterr().err
    assert "Traceback" in err
    assert "in run" in err
