import pytest

from manip_il.cli.main import main
from manip_il.cli.outputs import progress, say, set_quiet
from manip_il.errors import warn


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
    [last] = captured.err.splitlines()
    assert last.startswith("record: 3/3 (")
    assert last.endswith("success=0.123)")


def test_quiet_silences_progress_and_not_say(capsys):
    set_quiet(True)
    with progress(3, "record") as bar:
        bar.step()
    say("done")
    captured = capsys.readouterr()
    assert (captured.out, captured.err) == ("done\n", "")


def test_each_warning_is_one_line(capsys):
    main(["--help"])  # which prints warnings from here on
    warn("a joint has\nno range", "the other")
    warn()
    lines = capsys.readouterr().err.splitlines()
    assert lines == ["manip-il: warning: a joint has no range", "manip-il: warning: the other"]
