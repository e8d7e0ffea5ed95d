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

if TYPE_CHECKING:  # the table is read for help and mistakes, too, before anything heavy is imported
    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.run import Run, Watch
    from manip_il.engine.engine import Engine


@dataclass(frozen=True)
class Algorithm:
    """One way to learn. title: in reports. who: drives after round 0, in the help. rounds: its loop.

    learner_drives: in some rounds, so that label, query and beta mean something. takes_images: whether it is for
    policies that look at pictures, too.
    """

    title: str
    who: str
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


def run_algorithm(config: RunConfig, folder: Path, engine: Engine, watch: Watch | None = None) -> Iterator[RoundResult]:
    """Run, or go on with, the rounds of `config.method` in `folder`; see `Run.follow`."""
    from manip_il.algorithms.run import Run

    run = Run(config, folder, engine, watch)
    return run.follow(ALGORITHMS[config.method].rounds(run, config))
