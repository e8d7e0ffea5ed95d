"""A learnt reward against cloning on the same demonstrations, and on arms without any
demonstrations.

python benchmarks/reward_transfer.py [--taste NAME] [--demonstrations N] [--layouts N] [--steps N]
[--quick]

Records demonstrations of `carry` on the Panda on layouts with at most two things, learns the reward
from them with every method, and clones them. Then drives on unseen layouts, with three or four
things on the Panda and any number on the other arms, and sums the cost of the object's path under
the true weights. An episode that does not reach the goal is worse than any that does. Prints one
line per driver: episodes that reached the goal, mean cost above that of a driver with the true
weights on the same layouts, and on the Panda how often it is cheaper than the clone (sign test).

Limits: at most 5 % above on every arm; cheaper than the clone with p < 0.01.
"""

import argparse
import shutil
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from _machine import describe_machine
from scipy.stats import binomtest

from manip_il.chapter.inverse import CARRY, METHODS, carried_stretch, learn, read_carried
from manip_il.cli.main import main as manip_il
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.data.dataset import Dataset
from manip_il.data.journal import list_episodes, read_journal
from manip_il.data.schema import ENVIRONMENT_STATE
from manip_il.mdp import F64, Episode
from manip_il.seeding import rng_for, stream_base, stream_seeds
from manip_il.tasks.carry.layout import OBSTACLES, TASTES, Layout, Reward
from manip_il.tasks.carry.obstacles import EDGE, observed_layout
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.ladder.world import LadderEnv, scene_of
from manip_il.worlds.table import env_spec, make_config

FEW = 2  # most things in a demonstrated layout
ARMS = ("panda", "fetch", "so101")
ABOVE, P_VALUE = 0.05, 0.01
_SPARE = 6  # seeds to try per wanted layout


@dataclass(frozen=True)
class Driven:
    """Cost of an episode under the true weights; infinite if the goal was not reached."""

    seed: int
    cost: float


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--taste", default="careful", choices=list(TASTES))
    parser.add_argument("--demonstrations", type=int, default=50)
    parser.add_argument("--layouts", type=int, default=100)
    parser.add_argument("--steps", type=int, default=10_000, help="gradient steps of the clone")
    parser.add_argument(
        "--quick", action="store_true", help="a few of each: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    count, layouts, steps = (
        (3, 2, 20) if options.quick else (options.demonstrations, options.layouts, options.steps)
    )
    print(describe_machine())
    truth, missed = TASTES[options.taste], False
    with tempfile.TemporaryDirectory() as folder:
        root = demonstrate(Path(folder), options.taste, count)
        rewards = learnt(root)
        words = [
            f"--dataset.root={root}",
            f"--steps={steps}",
            f"--output_dir={folder}/clone",
            "--quiet",
        ]
        if manip_il(["train", *words]):
            raise SystemExit("the clone could not be fitted")
        clone = Path(folder) / "clone" / "checkpoints" / "last" / "pretrained_model"
        for arm in ARMS:
            own = drive(RolloutJob(_env(arm, truth), hold=1), truth, layouts, many=arm == ARMS[0])
            missed |= _print(arm, "true weights", own, own)
            cloned: list[Driven] = []
            if arm == ARMS[0]:
                job = RolloutJob(_env(arm, truth), PolicyDriver.of(clone), hold=1)
                cloned = drive(job, truth, layouts, many=True)
                _print(arm, "cloning", cloned, own)
            for method, reward in rewards.items():
                job = RolloutJob(_env(arm, reward), hold=1)
                found = drive(job, truth, layouts, many=arm == ARMS[0])
                missed |= _print(arm, method, found, own)
                missed |= bool(cloned) and _compare(found, cloned)
    return int(missed and not options.quick)


def demonstrate(folder: Path, taste: str, count: int) -> Path:
    """Record `count` episodes on layouts with few things; return their dataset."""
    root, kept = folder / "all", folder / "few.journals"
    words = [f"--task.type={CARRY}:{taste}", f"--dataset.root={root}", "--quiet"]
    if manip_il(
        ["record", *words, "--dataset.repo_id=benchmark/all", f"--dataset.num_episodes={3 * count}"]
    ):
        raise SystemExit("recording failed")
    names = Dataset.open(root).spec.environment_state_names
    journals = root.with_name("all.journals")
    few = [path for path in list_episodes(journals) if things(read_journal(path)[1], names) <= FEW][
        :count
    ]
    kept.mkdir()
    for path in few:
        shutil.copy(path, kept)
    if len(few) < count or manip_il(["data", "build", str(kept), str(folder / "few")]):
        raise SystemExit(
            f"only {len(few)} of {3 * count} layouts have at most {FEW} things, or no dataset was"
            " built"
        )
    return folder / "few"


def learnt(root: Path) -> dict[str, Reward]:
    """Return the reward that each method learns from a dataset."""
    shown = read_carried(root)
    rng = rng_for(stream_base("training", 0), "irl")
    return {method: Reward(tuple(learn(method, shown, rng).weights.tolist())) for method in METHODS}


def things(episode: Episode, names: Sequence[str]) -> int:
    """Return the number of things in an episode's layout, including the table's edge."""
    here = [names.index(f"{name}.here") for name in (*OBSTACLES, EDGE)]
    return int((np.asarray(episode.columns[ENVIRONMENT_STATE], np.float64)[0, here] > 0.5).sum())


def drive(job: RolloutJob, truth: Reward, layouts: int, *, many: bool) -> list[Driven]:
    """Return the costs of a job's first `layouts` unseen episodes. many: with more things than
    were demonstrated.
    """
    names = env_spec(job.env).environment_state_names
    found: list[Driven] = []
    for seed in _seeds(job.env, layouts, many=many):
        episode = next(job.run([seed]))
        found.append(Driven(seed, _cost(job.env, episode, names, truth)))
    return found


def _seeds(env: EnvConfig, layouts: int, *, many: bool) -> Iterator[int]:
    """Yield seeds of layouts that are in no demonstration, identified by their first
    observation.
    """
    simulated, left = LadderEnv(env), layouts
    names = env_spec(env).environment_state_names
    here = [names.index(f"{name}.here") for name in (*OBSTACLES, EDGE)]
    for seed in stream_seeds("held_out", _SPARE * layouts, 0):
        simulated.start(seed)
        if not many or int((simulated.observe().environment_state[here] > 0.5).sum()) > FEW:
            yield seed
            left -= 1
            if not left:
                return
    raise SystemExit(f"too few layouts with more than {FEW} things among {_SPARE * layouts} seeds")


def _cost(env: EnvConfig, episode: Episode, names: Sequence[str], truth: Reward) -> float:
    if not episode.success:
        return np.inf
    seen = episode.columns[ENVIRONMENT_STATE].astype(np.float64)
    scene = scene_of(env.robot, CARRY, env.object)
    layout = observed_layout(scene, dict(zip(names, seen[0].tolist(), strict=True)))
    at = seen[:, [names.index(f"{OBJECT}.{axis}") for axis in "xyz"]]
    return float(
        path_features(layout, carried_stretch(at, np.array(layout.goal))) @ np.array(truth.weights)
    )


def path_features(layout: Layout, positions: F64) -> F64:
    """Return the features of a path of the object's centre, (T, 3) [m], as line integrals along
    it, (K,).
    """
    pieces, steps = 20, np.diff(positions, axis=0)
    points = positions[:-1, None] + (np.arange(pieces) + 0.5)[:, None] / pieces * steps[:, None]
    densities = layout.densities(points.reshape(-1, 3)).reshape(len(steps), pieces, -1).mean(axis=1)
    return np.linalg.norm(steps, axis=1) @ densities


def _env(robot: str, reward: Reward) -> EnvConfig:
    return make_config(robot, f"{CARRY}:{reward.numbers}")


def _print(arm: str, name: str, found: list[Driven], own: list[Driven]) -> bool:
    """Print a line; return whether the limit on cost was missed."""
    pairs = [
        (a.cost, b.cost)
        for a, b in zip(found, own, strict=True)
        if np.isfinite([a.cost, b.cost]).all()
    ]
    above = sum(a for a, _ in pairs) / sum(b for _, b in pairs) - 1 if pairs else np.inf
    reached = sum(np.isfinite(one.cost) for one in found)
    cost = f"cost {above:+.1%} on {len(pairs)} layouts" if pairs else "no layout to compare"
    print(f"{arm}, {name}: {reached} of {len(found)} reached the goal; {cost}", flush=True)
    return above > ABOVE


def _compare(found: list[Driven], cloned: list[Driven]) -> bool:
    """Print on how many layouts `found` is cheaper than the clone.

    Return whether that is not significant.
    """
    pairs = [(a.cost, b.cost) for a, b in zip(found, cloned, strict=True)]
    cheaper, dearer = sum(a < b for a, b in pairs), sum(a > b for a, b in pairs)
    p_value = float(binomtest(cheaper, max(1, cheaper + dearer), alternative="greater").pvalue)
    print(f"   cheaper than the clone on {cheaper}, dearer on {dearer} layouts: p = {p_value:.2g}")
    return p_value >= P_VALUE


if __name__ == "__main__":
    sys.exit(main())
