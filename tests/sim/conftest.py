from __future__ import annotations

from collections.abc import Callable

import pytest

from manip_il.expert import Expert
from manip_il.sim.env import ManipEnv
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import phases


@pytest.fixture
def drive_until() -> Callable[[ManipEnv, str], None]:
    """Let the expert drive until its label is of a phase."""

    def drive(env: ManipEnv, phase: str) -> None:
        expert, names = Expert(env.scene), phases(TASKS[env.task])
        for _ in range(60):
            label = expert.label(env.get_state())
            if names[label.phase] == phase:
                return
            env.advance(label.action)
        raise AssertionError(f"the expert never reached {phase!r}")

    return drive


@pytest.fixture
def drive() -> Callable[[ManipEnv, int], None]:
    """Let the expert drive for so many control steps."""

    def drive(env: ManipEnv, steps: int) -> None:
        expert = Expert(env.scene)
        for _ in range(steps):
            env.advance(expert.label(env.get_state()).action)

    return drive
