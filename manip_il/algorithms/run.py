"""One run in a folder: what imitation and reinforcement learning have in common.

Every step leaves its result in the folder, whole, and is skipped if that is there already: a run that was killed goes
on where it was by running its loop again.
"""

from __future__ import annotations

import importlib
import shutil
import time
from collections.abc import Callable, Generator, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.atomic import new_folder
from manip_il.errors import ManipError
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL

BEST = "best"
STAGES = ("collect", "fit", "validate")


@dataclass(frozen=True)
class Watch:
    """Functions that a run calls with its progress. An exception from one ends the run; what is on disk stays."""

    on_stage: Callable[[str, int, int], None] = lambda stage, round_, total: None
    on_episode: Callable[[Episode | EpisodeResult], None] = lambda episode: None
    on_log: Callable[[dict[str, Any]], None] = lambda record: None  # {} at a step without metrics
    on_step: Callable[[], None] = lambda: None  # of anything else


@dataclass(frozen=True)
class Result:
    """One finished round of imitation, or iteration of reinforcement learning; 0 is what an iteration began with.

    steps, episodes: simulated so far. metrics: of the method, such as `labels`, the sound ones learnt from so far.
    policy: its checkpoint. validated: None if no validation was due. seconds: by stage, 0 of one that was found
    finished on disk.
    """

    unit: Literal["round", "iteration"]
    number: int
    steps: int
    episodes: int
    metrics: dict[str, float]
    policy: Path
    validated: EvalResult | None
    seconds: dict[str, float]

    @property
    def validation(self) -> EvalResult:
        """The validation. Raises `ManipError` if none was due."""
        if self.validated is None:
            raise ManipError(f"{self.unit} {self.number} was not validated")
        return self.validated

    @property
    def labels(self) -> int:
        """Sound labels learnt from so far."""
        return int(self.metrics["labels"])

    def to_json(self) -> dict[str, Any]:
        """Return one line of `metrics.jsonl`."""
        success = None if self.validated is None else self.validated.success
        return {
            self.unit: self.number,
            "steps": self.steps,
            "episodes": self.episodes,
            **self.metrics,
            "validation_success": None if success is None else success.rate,
            "validation_interval": None if success is None else list(success.interval),
            "validation_episodes": None if success is None else success.n,
            "seconds": self.seconds,
        }


def best_result(results: Iterable[Result]) -> Result:
    """Return the highest validation success; of equals the later, which has seen more."""
    return max(results, key=lambda result: (result.validation.success.rate, result.number))


class Run:
    """A folder, the workers, seconds by stage, and the validation by which the best policy is chosen."""

    def __init__(self, config: Any, folder: Path, engine: Engine, watch: Watch | None):
        self.config, self.folder = config, folder
        self._engine, self._watch = engine, watch or Watch()
        self._seconds: dict[str, float] = {}

    def results(self) -> Iterator[Result]:
        """Run, or go on with, the loop of the method: the function of its name, in the module of its name."""
        name = self.config.method
        loop = getattr(importlib.import_module(f"manip_il.algorithms.{name}"), name)
        return self.follow(loop(self, self.config))

    def follow(self, results: Iterator[Result]) -> Iterator[Result]:
        """Yield what a loop over the steps of this run yields, until the run has ended."""
        return results

    @contextmanager
    def _timed(self, stage: str) -> Generator[None]:
        """Add what a stage takes to the seconds."""
        started = time.monotonic()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.monotonic() - started

    def _take_seconds(self) -> dict[str, float]:
        """The seconds of every stage since the last call, rounded."""
        taken, self._seconds = dict.fromkeys(STAGES, 0.0) | self._seconds, {}
        return {stage: round(seconds, 3) for stage, seconds in taken.items()}

    def _validate(self, job: RolloutJob, path: Path, name: str) -> EvalResult:
        """Evaluate a job on the validation's seeds and write `path`, unless that has been done. name: in the file."""
        with self._timed("validate"):
            if path.is_file():
                return EvalResult.read(path)
            suite = job.conditions[0].name if job.conditions else NOMINAL.name
            seeds = stream_seeds("validation", self.config.validation_episodes, self.config.seed)
            found = evaluate(self._engine, job, seeds, name, self._watch.on_episode, suite=suite)
            found.write(path)
            return found

    def _keep_best(self, policy: Path) -> None:
        """Copy the best policy's `pretrained_model` to where it is looked for."""
        with new_folder(self.folder / BEST, replace=True) as new:
            shutil.copytree(policy, new / PRETRAINED_MODEL)
