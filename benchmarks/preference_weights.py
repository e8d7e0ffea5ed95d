"""A reward from 200 answers, and what weighing frames by it is worth where half of the episodes are a bad policy's.

python benchmarks/preference_weights.py [--task NAME] [--output DIR] [--quick]

Runs DAgger for policies of every kind, asks a teacher who is mistaken in a tenth of 200 pairs of its clips, learns the
reward, and measures its agreement with true progress on 2,000 pairs that nobody answered. Then records as many
demonstrations as the clone of a few has episodes, joins both with what was executed as the label, scores the episodes,
and clones the whole as it is and weighted. Prints agreement, the area under the ROC curve for failed episodes beside
that of true progress, and both clones' success on the same unseen seeds.

Limits: agreement at least 90 %, area at least 0.95, weighted ahead by at least 15 points with p < 0.001.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path

import numpy as np
from _machine import describe_machine

from manip_il.cli.main import main as manip_il
from manip_il.data import schema
from manip_il.data.lerobot_read import read_episodes, read_fingerprint, read_spec
from manip_il.data.lerobot_write import new_dataset
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.learn.checkpoint import PRETRAINED_MODEL
from manip_il.learn.reward import LearnedReward
from manip_il.mdp import Episode
from manip_il.preferences.choose import choose_pairs, open_supply
from manip_il.preferences.fitting import TIE, true_difference
from manip_il.preferences.frames import find_datasets
from manip_il.preferences.pairs import Clips

AGREEMENT, AREA, POINTS, P_VALUE = 0.90, 0.95, 0.15, 0.001
_FRESH, _CLIP = 2_000, 20


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--task", default="pick_place")
    parser.add_argument("--output", type=Path, help="folder of everything that is made; by default one that goes away")
    parser.add_argument("--quick", action="store_true", help="a few of each: shows that it runs, measures nothing")
    options = parser.parse_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as folder:
        return measure(options.output or Path(folder), options.task, quick=options.quick)


def measure(folder: Path, task: str, *, quick: bool) -> int:
    """Make everything in a folder; return 1 where a limit is missed."""
    few, episodes, steps, seeds = (2, 2, 20, 4) if quick else (30, 100, 2_000, 500)
    rounds, half, reward = folder / "rounds", folder / "half", folder / "reward"
    sizes = f"--demonstrations={few} --rounds={1 if quick else 5} --episodes_per_round={2 if quick else 40}"
    run(f"dagger --task.type={task} {sizes} --steps={steps} --validation_episodes={few} --seed=11", rounds)
    pairs, answers = folder / "pairs.json", folder / "preferences.json"
    manip(f"preferences pairs {rounds} --clip={_CLIP} --count={12 if quick else 200} --output={pairs}")
    manip(f"preferences answer {pairs} --teacher=mistaken:0.1 --output={answers}")
    run(f"preferences fit {pairs} {answers}", reward)
    agreement = fresh_agreement(rounds, reward, 20 if quick else _FRESH)
    good = f"record --robot.type=panda --task.type={task} --dataset.num_episodes={episodes} --dataset.repo_id=a/good"
    manip(f"{good} --dataset.root={folder / 'good'} --seed=21")
    poor = f"--policy.path={rounds / 'round_000' / 'policy'} --rounds=1 --episodes_per_round={episodes}"
    run(
        f"dagger --task.type={task} {poor} --disturbed_share=0 --steps=1 --validation_episodes=1 --seed=22",
        folder / "bad",
    )
    join(folder / "good", folder / "bad" / "round_001" / "dataset", half)
    run(f"score {half} --reward={reward}", folder / "scores")
    scores = json.loads((folder / "scores" / "scores.json").read_text())
    results: list[EvalResult] = []
    for name, weights in (("weighted", f"--weights={folder / 'scores' / 'rabc.parquet'}"), ("plain", "")):
        run(f"train --dataset.root={half} {weights} --steps={steps}", folder / name)
        run(f"eval --policy.path={folder / name} --eval.n_episodes={seeds}", folder / f"eval_{name}")
        results.append(EvalResult.read(folder / f"eval_{name}" / "eval.json"))
    compared = compare_results(results[1], results[0])
    print(f"agreement with true progress on pairs that nobody answered: {agreement}")
    print(f"area under the ROC curve, failed episodes: {scores['auc']}; by true progress {scores['auc_of_progress']}")
    print(f"weighted {results[0].success}, as it is {results[1].success}; {compared.verdict}")
    reached = (
        agreement.rate >= AGREEMENT,
        (scores["auc"] or 0) >= AREA,
        compared.difference >= POINTS and compared.p_value < P_VALUE,
    )
    return 0 if quick or all(reached) else 1


def fresh_agreement(rounds: Path, reward: Path, count: int) -> Proportion:
    """Share of other pairs of clips in which the reward agrees with true progress, but for ties."""
    supply = open_supply(find_datasets([rounds]), _CLIP)
    clips = Clips(choose_pairs(supply, count, 0, np.random.default_rng(999)), supply.frames)
    returns = LearnedReward.load(reward / PRETRAINED_MODEL).of_inputs(clips.inputs)[clips.rows].sum(-1)
    difference = true_difference(clips)
    assert difference is not None
    told = np.abs(difference) >= TIE
    return Proportion.of((((returns[:, 0] - returns[:, 1]) > 0) == (difference > 0))[told].tolist())


def join(good: Path, bad: Path, target: Path) -> None:
    """Write the episodes of two datasets as one, with what was executed as the label, as a recorder knows no other."""
    spec, episodes = read_spec(good), [[*read_episodes(root)] for root in (good, bad)]
    count = min(map(len, episodes))
    with new_dataset(target, spec, repo_id="a/half", fingerprint=read_fingerprint(good)) as writer:
        for episode in (one for group in episodes for one in group[:count]):
            writer.add(as_recorded(episode))
        writer.finish({})


def as_recorded(episode: Episode) -> Episode:
    """Return the episode with what was executed as its label."""
    columns = dict(episode.columns)
    columns[schema.ACTION] = columns[schema.EXECUTED_ACTION]
    columns[schema.LABEL_VALID] = np.ones_like(columns[schema.LABEL_VALID])
    return replace(episode, columns=columns)


def run(line: str, output: Path) -> None:
    manip(f"{line} --output_dir={output}")


def manip(line: str) -> None:
    if manip_il([*line.split(), "--quiet"]) != 0:
        raise SystemExit(f"manip-il {line} failed")


if __name__ == "__main__":
    sys.exit(main())
