from __future__ import annotations

from functools import cache

import pytest

from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.mdp import State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.env import EnvConfig

SIZES = Condition("sizes", size=(0.03, 0.07), mass=(0.05, 0.3))


@cache
def visited(robot: str, task: str, driver: str) -> tuple[State, ...]:
    """driver: "varied" is the expert's own path with cubes of many sizes."""
    conditions = (SIZES,) if driver == "varied" else ()
    driver = "expert" if driver == "varied" else driver
    job = RolloutJob(EnvConfig(robot, task, horizon=40), driver, hold=3, conditions=conditions)  # pyright: ignore[reportArgumentType]
    episodes = run_job(job, stream_seeds("certificate", 2))
    return tuple(State.from_vector(row) for episode in episodes for row in episode.columns["sim_state"])


@pytest.fixture(scope="session")
def visited_states():
    """States of two episodes that a driver visited."""
    return visited
