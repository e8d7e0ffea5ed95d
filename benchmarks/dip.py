"""Does DAgger's success dip when the data are aggregated, and what prevents it?

python benchmarks/dip.py [--seed N] [--rounds N] [--quick]

The same run three times: unchanged; with the input normalisation frozen at the first round, like a normaliser that is
fitted once; and with labels that jump straight to the inverse kinematics' target, unclipped. Prints the validation
success of every round and the largest drop from the best previous round.

Peer: the `imitation` library's DAgger on stock FetchPickAndPlace dropped from 91 to 6 % in its second round, and to
37.5 % with its normaliser refreshed every round.
"""

from __future__ import annotations

import argparse
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from _machine import describe_machine
from numpy.typing import NDArray

import manip_il.collect.expert as expert
import manip_il.learn.mlp as mlp
from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.run import Run
from manip_il.collect.environments import make_expert
from manip_il.collect.workers import Engine
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.network import Statistics
from manip_il.robots.ik import ArmIK

F64 = NDArray[np.float64]
FAR = 10.0  # [m], [rad]: no limit


@contextmanager
def as_it_is() -> Iterator[None]:
    yield


@contextmanager
def frozen_units() -> Iterator[None]:
    """Use the statistics of the first fit in every fit."""
    plain, first = mlp.fit_statistics, list[Statistics]()

    def fit_statistics(*data: Any) -> Statistics:
        first.append(plain(*data))
        return first[0]

    with patch.object(mlp, "fit_statistics", fit_statistics):
        yield


@contextmanager
def jumping_labels() -> Iterator[None]:
    """Set the hand's target to its final pose, however far, and do not clip joint steps of the IK."""
    plain = ArmIK.step

    def unclipped(ik: ArmIK, position: F64, rotation: F64, _longest: float, lean: float) -> tuple[F64, float] | None:
        return plain(ik, position, rotation, FAR, lean)

    make_expert.cache_clear()
    unbounded: dict[str, Any] = {
        "_clip_norm": lambda vector, _longest: vector,
        "turned_towards": lambda _rotation, target, _largest: target,
    }
    with patch.object(ArmIK, "step", unclipped), patch.multiple(expert, **unbounded):
        yield
    make_expert.cache_clear()


VARIANTS: dict[str, Callable[[], AbstractContextManager[None]]] = {
    "as it is": as_it_is,
    "units frozen at round 0": frozen_units,
    "labels that jump": jumping_labels,
}


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--quick", action="store_true", help="one tiny round: shows that it runs, measures nothing")
    options = parser.parse_args()
    print(describe_machine())
    for name, variant in VARIANTS.items():
        with variant():
            rates = validation(options.seed, options.rounds, options.quick)
        shown = " ".join(f"{100 * rate:.1f}" for rate in rates)
        print(f"{name}: success by round {shown} %; largest fall {100 * fall(rates):.1f} points", flush=True)
    return 0


def validation(seed: int, rounds: int, quick: bool) -> list[float]:
    """Return the validation success of every round of one run."""
    config = RunConfig(
        demonstrations=4 if quick else 50,
        rounds=1 if quick else rounds,
        episodes_per_round=2 if quick else 50,
        fit=FitConfig(steps=20 if quick else 3_000, batch_size=256),
        validation_episodes=2 if quick else 200,
        seed=seed,
    )
    # in this process only, as other processes would not have the patches
    with tempfile.TemporaryDirectory() as folder, Engine(1) as engine:
        return [result.validation.success.rate for result in Run(config, Path(folder), engine).results()]


def fall(rates: list[float]) -> float:
    """Return the largest drop of a round below the best one before it, 0 if there is none."""
    best = np.maximum.accumulate(rates)
    return float((best - rates).max())


if __name__ == "__main__":
    sys.exit(main())
