"""Wall-clock from scratch to policies of 99 % and 99.5 % success on Fetch pick-and-place with 5 cm
tolerance.

python benchmarks/time_to_policy.py [--seed=N] [--peer=PYTHON] [--quick]

`configs/fetch_5cm.yaml`: includes demonstrations, DAgger's rollouts, fitting and starting the
worker processes, but not the evaluation on 200 validation seeds. In the same run, the `imitation`
library clones 200 demonstrations of the stock environment, also without evaluation in its time, and
is tested on 200 seeds. PYTHON is the interpreter of an environment with that library, which needs
other versions than this project:

python3.11 -m venv peer && peer/bin/pip install imitation==1.0.1 gymnasium-robotics==1.2.4
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from _machine import describe_machine

from manip_il.algorithms.config import RunConfig
from manip_il.algorithms.run import Run
from manip_il.cli.imitation import DaggerOptions
from manip_il.cli.parsing import from_yaml
from manip_il.cli.run.imitation import dagger_config
from manip_il.collect.workers import Engine, default_workers

HERE = Path(__file__).parent
GOALS = (0.99, 0.995)
EPOCHS = 150  # epochs of the library's cloning


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--peer", type=Path, help="interpreter with the imitation library; without it, no ratio"
    )
    parser.add_argument(
        "--quick", action="store_true", help="one small round: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    if options.peer is not None and not options.peer.is_file():
        parser.error(
            f"--peer is {options.peer}, which is no file; expected the Python of an environment"
        )
    print(describe_machine())
    limit = None
    if options.peer is not None:
        found = clone_by_peer(options.peer, options.seed, 2 if options.quick else EPOCHS)
        limit = found["seconds"]
        print(
            f"imitation: {found['success']:.1%} from {found['labels']:,} labels after"
            f" {limit:.1f} s",
            flush=True,
        )
    given = from_yaml(HERE.parent / "configs" / "fetch_5cm.yaml", DaggerOptions)
    config = dagger_config(replace(given, settings=given.settings | {"seed": options.seed}))
    if options.quick:
        few = {
            "demonstrations": 4,
            "rounds": 1,
            "episodes_per_round": 4,
            "validation_episodes": 4,
            "refit_steps": 20,
        }
        config = replace(config, **few, fit=replace(config.fit, steps=50))
    left = reach_goals(config, limit)
    for goal in left:
        print(f"{goal:.1%} was not reached in {config.rounds} rounds")
    return 1 if left and not options.quick else 0


def reach_goals(config: RunConfig, limit: float | None) -> list[float]:
    """Print every round until the last goal is reached; return the goals that are not reached."""
    print("round  labels  success (200 validation seeds)  seconds without evaluation")
    left, started, evaluation = list(GOALS), time.monotonic(), 0.0
    with tempfile.TemporaryDirectory() as folder, Engine(default_workers()) as engine:
        for result in Run(config, Path(folder), engine).results():
            evaluation += result.seconds["validate"]
            spent = time.monotonic() - started - evaluation
            print(
                f"{result.number:5d}  {result.labels:6d}  {result.validation.success!s:30s} "
                f" {spent:6.1f}",
                flush=True,
            )
            while left and result.validation.success.rate >= left[0]:
                ratio = "" if limit is None else f": {spent / limit:.2f} of imitation's time"
                print(f"{left.pop(0):.1%} after {spent:.1f} s and {result.labels:,} labels{ratio}")
            if not left:
                break
    return left


def clone_by_peer(python: Path, seed: int, epochs: int) -> dict[str, float]:
    """Return the library's cloning time [s], number of labels and success."""
    words = [str(python), str(HERE / "_imitation_cloning.py"), str(seed), str(epochs)]
    # our choice of OpenGL makes it crash
    own = {name: value for name, value in os.environ.items() if "GL" not in name}
    done = subprocess.run(words, check=True, capture_output=True, text=True, env=own)
    return json.loads(done.stdout.splitlines()[-1])


if __name__ == "__main__":
    sys.exit(main())
