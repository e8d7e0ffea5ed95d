from __future__ import annotations

from collections.abc import Callable

import pytest

from manip_il.expert.expert import Expert
from manip_il.mdp import Phase
from manip_il.sim.env import ManipEnv


@pytest.fixture
def drive_until() -> Callable[[ManipEnv, Phase], None]:
    """Let the expert drive until its label is of a phase."""

    def drive(env: ManipEnv, phase: Phase) -> None:
        expert = Expert(env.scene)
        for _ in range(60):
            label = expert.label(env.get_state())
            if label.phase == phase:
                return
            env.advance(label.action)
        raise AssertionError(f"the expert never reached {phase!r}")

    return drive
