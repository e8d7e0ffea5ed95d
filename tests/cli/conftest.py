"""What tests of commands share."""

from collections.abc import Callable
from pathlib import Path

import pytest

from manip_il.errors import RenderError
from manip_il.evaluation import measuring
from manip_il.evaluation.measuring import finished_episodes

from .made_runs import make_policy


@pytest.fixture
def here(tmp_path, monkeypatch) -> Path:
    """An empty folder, which is the current one."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def error(capsys) -> Callable[[], str]:
    """Returns the one line of error since the last output was read."""

    def line() -> str:
        err = capsys.readouterr().err
        lines = [line for line in err.splitlines() if line.startswith("manip-il: error:")]
        assert len(lines) == 1, err
        return lines[0]

    return line


@pytest.fixture(scope="session")
def policy(tmp_path_factory) -> Path:
    """A policy for panda reach that acts, badly; not to be changed."""
    return make_policy(tmp_path_factory.mktemp("made") / "policy")


@pytest.fixture
def evaluated(monkeypatch) -> list[str]:
    """The policies of which episodes were run, by name."""
    names: list[str] = []
    real = measuring.measure

    def counted(engine, job, seeds, name, progress, *, folder, suite, **named):
        if set(seeds) - finished_episodes(folder, job, suite).keys():
            names.append(name)
        return real(engine, job, seeds, name, progress, folder=folder, suite=suite, **named)

    monkeypatch.setattr(measuring, "measure", counted)
    return names


@pytest.fixture
def no_opengl(monkeypatch) -> None:
    """No environment can draw."""

    def refuse(*_: object) -> None:
        raise RenderError("no OpenGL here")

    monkeypatch.setattr("manip_il.sim.env.pictures", refuse)
