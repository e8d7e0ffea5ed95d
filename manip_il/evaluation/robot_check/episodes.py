"""How often the expert solves a task with a robot, as it is and with random actions in between."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.runner import HOLD, evaluate
from manip_il.sim.conditions import Condition
from manip_il.sim.config import EnvConfig


@dataclass(frozen=True)
class ExpertFacts:
    """Success of the expert, and its failed episodes by the phase that they ended in."""

    success: Proportion
    failures: Mapping[str, int]


def expert_facts(
    engine: Engine,
    robot: str,
    task: str,
    seeds: Sequence[int],
    condition: Condition,
    on_result: Callable[[EpisodeResult], object],
) -> ExpertFacts:
    """Run the expert on seeds under a condition."""
    job = RolloutJob(EnvConfig(robot, task), hold=HOLD, label="last", conditions=(condition,))
    result = evaluate(engine, job, seeds, "expert", on_result, suite=condition.name)
    return ExpertFacts(result.success, result.failures)
