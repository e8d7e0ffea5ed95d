"""Inverse reinforcement learning on `carry`: regret of learnt rewards on unseen layouts.

python benchmarks/inverse.py [--seed N] [--demonstrations N] [--layouts N] [--robot R] [--quick]

Records demonstrations of three tastes on the arm, learns weights from each with every method, and
plans with them on unseen layouts. Prints by how much the plans' cost under the true weights exceeds
that of the demonstrator's own plans, next to plans for length alone, and the time that learning
took.

Limits: 3 % above for maximum entropy and Bayesian, 10 % for maximum margin; 60 s for maximum margin
and maximum entropy, 300 s for Bayesian.
"""

import argparse
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from _machine import describe_machine
from numpy.typing import NDArray

from manip_il.chapter.inverse import CARRY, METHODS, learn, read_carried
from manip_il.cli.main import main as manip_il
from manip_il.seeding import rng_for, stream_base, stream_seeds
from manip_il.tasks.carry.grid import Grid, PathProblem, plan
from manip_il.tasks.carry.layout import TASTES
from manip_il.tasks.carry.obstacles import layout_of
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.ladder.world import LadderEnv
from manip_il.worlds.table import make_config

F64 = NDArray[np.float64]
ABOVE = {"max_margin": 0.10, "bayesian": 0.03, "max_entropy": 0.03}
SECONDS = {"max_margin": 60.0, "bayesian": 300.0, "max_entropy": 60.0}
_LEAST = 1e-9  # weight of other features relative to that of length, to break ties


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--robot", default="panda")
    parser.add_argument("--demonstrations", type=int, default=50)
    parser.add_argument("--layouts", type=int, default=100, help="unseen layouts to plan on")
    parser.add_argument(
        "--quick", action="store_true", help="a few of each: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    demonstrations, layouts = (4, 3) if options.quick else (options.demonstrations, options.layouts)
    print(describe_machine())
    learnt = {taste: _learn(options.robot, taste, demonstrations, options.seed) for taste in TASTES}
    plain = np.full(len(next(iter(TASTES.values())).weights), _LEAST) + _LEAST
    plain[0] = 1.0
    costs: dict[tuple[str, str], list[float]] = {}
    for problem, start in unseen(options.robot, layouts, options.seed):
        for taste, found in learnt.items():
            truth = np.array(TASTES[taste].weights)
            for name, weights in {
                "own": truth,
                "length": plain,
                **{m: w for m, (w, _) in found.items()},
            }.items():
                sums = plan(problem, weights).path(start)[1]
                costs.setdefault((taste, name), []).append(float(sums @ truth))
    missed = _print(learnt, {key: float(np.mean(values)) for key, values in costs.items()})
    return int(missed and not options.quick)


def unseen(robot: str, count: int, seed: int) -> Iterator[tuple[PathProblem, int]]:
    """Yield the grids of layouts that are in no demonstration, and the node nearest to the
    object in each.
    """
    env = LadderEnv(make_config(robot, CARRY))
    for one in stream_seeds("held_out", count, seed):
        env.reset(seed=one)
        grid = Grid(layout_of(env.world), env.world.scene.robot)
        at = env.world.pose(OBJECT).position
        near = grid.near(at)
        yield grid.problem, int(near[np.argmin(np.linalg.norm(grid.points[near] - at, axis=1))])


def _learn(robot: str, taste: str, count: int, seed: int) -> dict[str, tuple[F64, float]]:
    """Return the weights (K,) that every method learns, and the time that it takes [s]."""
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder) / taste
        words = [f"--robot.type={robot}", f"--task.type={CARRY}:{taste}", f"--dataset.root={root}"]
        more = [
            f"--dataset.repo_id=benchmark/{taste}",
            f"--dataset.num_episodes={count}",
            f"--seed={seed}",
        ]
        if manip_il(["record", *words, *more, "--quiet"]):
            raise SystemExit("recording failed")
        shown = read_carried(root)
    found = dict[str, tuple[F64, float]]()
    for method in METHODS:
        begin = time.perf_counter()
        weights = learn(method, shown, rng_for(stream_base("training", seed), "irl")).weights
        found[method] = weights, time.perf_counter() - begin
    return found


def _print(
    learnt: dict[str, dict[str, tuple[F64, float]]], costs: dict[tuple[str, str], float]
) -> bool:
    """Print one line per taste and method; return whether a limit was missed."""
    missed = False
    for taste, found in learnt.items():
        own = costs[taste, "own"]
        print(f"{taste}: length alone {costs[taste, 'length'] / own - 1:.1%} above")
        for method, (weights, seconds) in found.items():
            above = costs[taste, method] / own - 1
            missed |= above > ABOVE[method] or seconds > SECONDS[method]
            print(
                f"{taste}, {method}: {above:.2%} above (limit {ABOVE[method]:.0%}), {seconds:.0f} s"
            )
            print("   weights over length's: " + " ".join(f"{one:.2f}" for one in weights))
    return missed


if __name__ == "__main__":
    sys.exit(main())
