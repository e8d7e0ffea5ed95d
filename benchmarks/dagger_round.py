"""Wall-clock of one round of DAgger: 50 episodes rolled out and labelled, aggregated, refitted
warm, validated.

python benchmarks/dagger_round.py [--seed N] [--validation N] [--quick]

Panda pick_place, the mlp on state, labels in every state. Limit: 30 s per round on two cores, of
which labelling takes at most 15 %: the time that one core needs to label every state of the round
again, divided by the number of workers, relative to the round's wall-clock in the same run.
"""

import argparse
import sys
import tempfile
import time
from pathlib import Path

from _machine import describe_machine

from manip_il import Expert
from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.results import Result
from manip_il.algorithms.rounds import DATASET, round_folder
from manip_il.algorithms.run import Run
from manip_il.collect.workers import Engine, default_workers
from manip_il.data.dataset import Dataset
from manip_il.learn.fit_config import FitConfig
from manip_il.mdp import State
from manip_il.worlds.ladder.world import scene_of

LIMIT, SHARE = 30.0, 0.15  # time of a round [s], and the largest share of it for labelling


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--validation", type=int, default=200, help="episodes")
    parser.add_argument(
        "--quick", action="store_true", help="one tiny round: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    config = RunConfig(
        demonstrations=4 if options.quick else 50,
        rounds=1 if options.quick else 3,
        episodes_per_round=4 if options.quick else 50,
        refit="warm",
        refit_steps=20 if options.quick else 1_000,
        fit=FitConfig(steps=20 if options.quick else 3_000),
        validation_episodes=4 if options.quick else options.validation,
        seed=options.seed,
    )
    workers = default_workers()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as name, Engine(workers) as engine:
        for result in Run(config, Path(name), engine).results():
            report(result, Path(name), config, workers)
    return 0


def report(result: Result, folder: Path, config: RunConfig, workers: int) -> None:
    """Print one line per round."""
    whole = sum(result.seconds.values())
    stages = ", ".join(f"{stage} {seconds:.1f}" for stage, seconds in result.seconds.items())
    line = f"round {result.number}: {whole:.1f} s ({stages}), {whole / LIMIT:.2f} of the limit"
    if result.number:
        labelling = (
            seconds_to_label(round_folder(folder, result.number) / DATASET, config) / workers
        )
        line += f"; labelling {labelling:.2f} s, {labelling / whole:.1%} of it (limit {SHARE:.0%})"
    print(f"{line}; success {result.validation.success}", flush=True)


def seconds_to_label(root: Path, config: RunConfig) -> float:
    """Return how long one core takes to query the expert in every state of a dataset [s]."""
    expert = Expert(scene_of(config.env.robot, config.env.task))
    states = [
        State.from_vector(vector)
        for vector in Dataset.open(root).columns(("sim_state",))["sim_state"]
    ]
    expert.label(states[0])
    started = time.perf_counter()
    for state in states:
        expert.label(state)
    return time.perf_counter() - started


if __name__ == "__main__":
    sys.exit(main())
