"""The algorithms by name: a new one is a file beside this one, and a line here."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manip_il.algorithms.cloning import cloning
from manip_il.algorithms.dagger import dagger
from manip_il.algorithms.dart import dart
from manip_il.algorithms.rounds import RoundResult
from manip_il.errors import UnknownName, UsageError

if TYPE_CHECKING:  # the table is read for help and mistakes, too, before anything heavy is imported
    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.run import Run, Watch
    from manip_il.collect.workers import Engine


@dataclass(frozen=True)
class Algorithm:
    """One way to learn. title: in reports. driver: after round 0, for the help. rounds: its loop.

    learner_drives: whether it does in some rounds, so that label, query and beta mean something. takes_images: whether
    policies may look at pictures.
    """

    title: str
    driver: str
    rounds: Callable[[Run, RunConfig], Iterator[RoundResult]]
    learner_drives: bool = True
    takes_images: bool = True


ALGORITHMS = {
    "dagger": Algorithm("DAgger", "the learner", dagger),
    "cloning": Algorithm("Cloning", "the expert", cloning, learner_drives=False),
    "dart": Algorithm(
        "DART", "the expert with noise like the learner's errors", dart, learner_drives=False, takes_images=False
    ),
}

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[*ALGORITHMS]  # the choices of `--method`


def check_method(config: RunConfig) -> None:
    """Raise `UnknownName` for a method that is not in the table, `UsageError` for options that are not for it."""
    if config.method not in ALGORITHMS:
        raise UnknownName("method", config.method, ALGORITHMS)
    algorithm = ALGORITHMS[config.method]
    if config.has_queries and not algorithm.learner_drives:
        raise UsageError(f"method {config.method!r} has the expert drive throughout; leave out label, query and beta")
    if config.fit.takes_images and not algorithm.takes_images:
        raise UsageError(
            f"method {config.method!r} measures the learner's errors from state vectors; it is not for a policy on "
            "images"
        )


def run_algorithm(config: RunConfig, folder: Path, engine: Engine, watch: Watch | None = None) -> Iterator[RoundResult]:
    """Run, or go on with, the rounds of `config.method`; see `Run.follow`. Raises what `check_method` raises."""
    from manip_il.algorithms.run import Run

    check_method(config)
    run = Run(config, folder, engine, watch)
    return run.follow(ALGORITHMS[config.method].rounds(run, config))
