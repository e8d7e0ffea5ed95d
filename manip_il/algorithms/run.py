"""One run in a folder: what imitation and reinforcement learning have in common.

Every step leaves its result in the folder, whole, and is skipped if that is there already: a run that was killed goes
on where it was by running its loop again.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.atomic import new_folder
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL

BEST = "best"


@dataclass(frozen=True)
class Watch:
    """Functions that a run calls with its progress. An exception from one ends the run; what is on disk stays."""

    on_stage: Callable[[str, int, int], None] = lambda stage, round_, total: None
    on_episode: Callable[[Episode | EpisodeResult], None] = lambda episode: None
    on_log: Callable[[dict[str, Any]], None] = lambda record: None  # {} at a step without metrics
    on_step: Callable[[], None] = lambda: None  # of anything else


class Run:
    """A folder, the workers, seconds by stage, and the validation by which the best policy is chosen."""

    def __init__(self, folder: Path, engine: Engine, watch: Watch | None):
        self.folder = folder
        self._engine, self._watch = engine, watch or Watch()
        self._seconds: dict[str, float] = {}

    @contextmanager
    def _timed(self, stage: str) -> Generator[None]:
        """Add what a stage takes to the seconds."""
        started = time.monotonic()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.monotonic() - started

    def _take_seconds(self, digits: int) -> dict[str, float]:
        """The seconds of every stage since the last call, rounded."""
        taken, self._seconds = self._seconds, {}
        return {stage: round(seconds, digits) for stage, seconds in taken.items()}

    def _evaluate(self, job: RolloutJob, name: str, count: int, seed: int) -> EvalResult:
        """Evaluate a policy on the validation's seeds."""
        suite = job.conditions[0].name if job.conditions else NOMINAL.name
        seeds = stream_seeds("validation", count, seed)
        return evaluate(self._engine, job, seeds, name, self._watch.on_episode, suite=suite)

    def _keep_best(self, policy: Path) -> None:
        """Copy the best policy's `pretrained_model` to where it is looked for."""
        with new_folder(self.folder / BEST, replace=True) as new:
            shutil.copytree(policy, new / PRETRAINED_MODEL)
