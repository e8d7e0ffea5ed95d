"""A reward from 200 answers, and the gain from weighting frames by it if half of the episodes are a
bad policy's.

python benchmarks/preference_weights.py [--task NAME] [--output DIR] [--quick]

Runs DAgger for policies of varying quality, asks a teacher who errs in a tenth of the answers about
100 pairs of their clips, learns a reward, asks about 100 more on which its networks disagree, and
relearns the reward from all 200. Measures its agreement with true progress on 2,000 pairs without
answers, for five draws of pairs and errors. Then joins 100 demonstrations with 100 episodes of
round 0's policy, both with the executed actions as labels, scores the episodes with the first
draw's reward, and clones the joined data unweighted, weighted, and the demonstrations alone. Prints
agreement, the area under the ROC curve for failed episodes beside that of true progress, and the
clones' success on the same unseen seeds.

Limits: mean agreement at least 90 %, area at least 0.95, weighted ahead by at least 15 points with
p < 0.001.
"""

import argparse
import json
import sys
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from _machine import describe_machine
from scipy.special import expit

from manip_il.chapter.preferences.pairs import Pairs, choose_pairs, find_datasets, read_clips
from manip_il.chapter.reward import LearnedReward
from manip_il.cli.main import main as manip_il
from manip_il.data import schema
from manip_il.data.atomic import write_json
from manip_il.data.build import merge_datasets
from manip_il.data.dataset import Dataset, EpisodeData, Own
from manip_il.data.lerobot_write import write_episodes
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.side import Side
from manip_il.learn.training_state import PRETRAINED_MODEL

AGREEMENT, AREA, POINTS, P_VALUE = 0.90, 0.95, 0.15, 0.001
_FRESH, _CLIP, _DRAWS = 2_000, 20, 5
_POOL = 10  # pairs drawn for each of those that are asked for being doubtful
_TIE = 0.01  # if the clips' mean progress differs by less, neither is better


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--task", default="pick_place")
    parser.add_argument(
        "--output", type=Path, help="folder for all results; by default a temporary one"
    )
    parser.add_argument(
        "--quick", action="store_true", help="a few of each: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    print(describe_machine())
    with tempfile.TemporaryDirectory() as folder:
        return measure(options.output or Path(folder), options.task, quick=options.quick)


def measure(folder: Path, task: str, *, quick: bool) -> int:
    """Create everything in a folder; return 1 if a limit is missed."""
    few, episodes, steps, seeds = (2, 2, 20, 4) if quick else (30, 100, 2_000, 500)
    rounds, half = folder / "rounds", folder / "half"
    sizes = (
        f"--demonstrations={few} --rounds={1 if quick else 5}"
        f" --episodes_per_round={2 if quick else 40}"
    )
    run(
        f"dagger --task.type={task} {sizes} --steps={steps} --validation_episodes={few} --seed=11",
        rounds,
    )
    rewards = [
        learn_reward(rounds, folder, draw, 12 if quick else 100)
        for draw in range(1 if quick else _DRAWS)
    ]
    agreements = [fresh_agreement(rounds, reward, 20 if quick else _FRESH) for reward in rewards]
    good = (
        f"record --robot.type=panda --task.type={task} --dataset.num_episodes={episodes}"
        " --dataset.repo_id=a/good"
    )
    manip(f"{good} --dataset.root={folder / 'good'} --seed=21")
    poor = (
        f"--policy.path={rounds / 'round_000' / 'policy'} --rounds=1"
        f" --episodes_per_round={episodes}"
    )
    run(
        f"dagger --task.type={task} {poor} --disturbed_share=0 --steps=1 --validation_episodes=1"
        " --seed=22",
        folder / "bad",
    )
    join(folder / "good", folder / "bad" / "round_001" / "dataset", half)
    run(f"data score {half} --reward={rewards[0]}", folder / "scores")
    run(f"data score {half} --reward=progress", folder / "true_scores")
    area, true = (roc_auc(folder / name / "scores.json") for name in ("scores", "true_scores"))
    weights = f"--weights={folder / 'scores' / 'rabc.parquet'}"
    sources = {
        "weighted": f"{half} {weights}",
        "as it is": half,
        "demonstrations alone": folder / "good",
    }
    results = {name: clone(folder, name, source, steps, seeds) for name, source in sources.items()}
    compared = Comparison(*(Side.of(name, results[name]) for name in ("as it is", "weighted")))
    agreement = float(np.mean([one.rate for one in agreements]))
    print(f"agreement with true progress on pairs that nobody answered: mean {agreement:.1%}")
    print("\n".join(f"  draw {draw}: {one} of {one.n:,}" for draw, one in enumerate(agreements)))
    print(f"area under the ROC curve, failed episodes: {area}; by true progress {true}")
    print("\n".join(f"{name}: {result.success}" for name, result in results.items()))
    print(f"weighted against as it is: {compared.verdict}")
    reached = (
        agreement >= AGREEMENT,
        area >= AREA,
        compared.difference >= POINTS and compared.p_value < P_VALUE,
    )
    return 0 if quick or all(reached) else 1


def learn_reward(rounds: Path, folder: Path, draw: int, count: int) -> Path:
    """Learn a reward from `count` answers, and again with as many more on pairs on which its
    networks disagree.
    """
    made = folder / f"draw_{draw}"
    made.mkdir(parents=True, exist_ok=True)
    first, reward = made / "first", made / "reward"
    chosen, asked = made / "pairs.json", made / "more_pairs.json"
    for path, number, seed in ((chosen, count, draw), (asked, _POOL * count, draw + 500)):
        manip(
            f"reward pairs {rounds} --clip={_CLIP} --count={number} --seed={seed} --output={path}"
        )
    fit_reward(rounds, chosen, draw, first)
    both = doubtful(rounds, LearnedReward.load(first / PRETRAINED_MODEL), asked, count)
    evenly = Pairs.read(chosen)
    write_json(asked, replace(evenly, pairs=evenly.pairs + both).to_json())
    fit_reward(rounds, asked, draw, reward)
    return reward


def fit_reward(rounds: Path, pairs: Path, seed: int, folder: Path) -> None:
    """Have the teacher answer pairs, and fit a reward to the answers."""
    answers = pairs.with_name(f"{pairs.stem}_answers.json")
    manip(
        f"reward answer {pairs} --sources={rounds} --teacher=mistaken:0.1 --seed={seed}"
        f" --output={answers}"
    )
    run(f"reward fit {pairs} {answers} --sources={rounds} --seed={seed}", folder)


def doubtful(rounds: Path, reward: LearnedReward, path: Path, count: int) -> tuple[Any, ...]:
    """Return the pairs in a file on which a reward's networks disagree most, by the standard
    deviation of P(left is better) (Christiano et al. 2017, section 2.2.4).
    """
    clips = read_clips(Pairs.read(path), find_datasets([rounds]))
    inputs, sides = torch.from_numpy(clips.data.inputs), torch.from_numpy(clips.rows)
    with torch.inference_mode():
        parts = [reward.network.logits(inputs, part) for part in sides.split(256)]
    doubt = expit(torch.cat(parts, dim=1).numpy().astype(np.float64)).std(axis=0)
    kept = np.sort(np.argsort(-doubt, kind="stable")[:count])
    return tuple(clips.pairs.pairs[place] for place in kept)


def clone(folder: Path, name: str, source: object, steps: int, seeds: int) -> EvalResult:
    """Clone a dataset and evaluate the clone on unseen seeds. source: the dataset's folder, with
    `--weights` if any.
    """
    word = name.replace(" ", "_")
    run(f"train --dataset.root={source} --steps={steps}", folder / word)
    run(f"eval --policy.path={folder / word} --eval.n_episodes={seeds}", folder / f"eval_{word}")
    return EvalResult.read(folder / f"eval_{word}" / "eval.json")


def fresh_agreement(rounds: Path, reward: Path, count: int) -> Proportion:
    """Return the share of new pairs of clips, without ties, on which the reward agrees with true
    progress.
    """
    clips = choose_pairs(find_datasets([rounds]), _CLIP, count, 0, np.random.default_rng(999))
    returns = LearnedReward.load(reward / PRETRAINED_MODEL)(clips.data.inputs)[clips.rows].sum(-1)
    means = clips.data.progress[clips.rows].mean(axis=-1)
    difference = means[:, 0] - means[:, 1]
    told = np.abs(difference) >= _TIE
    return Proportion.of((((returns[:, 0] - returns[:, 1]) > 0) == (difference > 0))[told].tolist())


def roc_auc(scores: Path) -> float:
    """Return the share of pairs of a failed and a successful episode in which the failed one has
    the lower score; equal scores count half.

    This is the area under the ROC curve for detecting failed episodes by a low score (Mann and
    Whitney 1947).
    """
    episodes = json.loads(scores.read_text())["episodes"]
    good, bad = (
        np.array([one["score"] for one in episodes if one["success"] == success])
        for success in (True, False)
    )
    above = good[:, None] - bad
    return float(((above > 0) + 0.5 * (above == 0)).mean())


def join(good: Path, bad: Path, target: Path) -> None:
    """Write the episodes of two datasets as one, labelled with the executed actions, the only
    ones a recorder knows.
    """
    datasets, made = (
        [*map(Dataset.open, (good, bad))],
        [target.with_name(name) for name in ("half_good", "half_bad")],
    )
    for dataset, part in zip(datasets, made, strict=True):
        own = Own(dataset.spec, dataset.fingerprint, dataset.provenance)
        episodes = map(as_recorded, dataset.stored_episodes())
        write_episodes(
            episodes, part, dataset.stored_features, dataset.fps, dataset.info.robot, own
        )
    first, second = (dataset.info.episodes for dataset in datasets)
    count = min(first, second)
    merge_datasets(made, target, [f"0:{count}", f"{first}:{first + count}"])


def as_recorded(episode: EpisodeData) -> EpisodeData:
    """Return an episode with the executed actions as labels."""
    action = episode.columns[schema.EXECUTED_ACTION]
    labels = {schema.ACTION: action, schema.LABEL_VALID: np.ones(len(action), np.int64)}
    return replace(episode, columns={**episode.columns, **labels})


def run(line: str, output: Path) -> None:
    manip(f"{line} --output_dir={output}")


def manip(line: str) -> None:
    if manip_il([*line.split(), "--quiet"]) != 0:
        raise SystemExit(f"manip-il {line} failed")


if __name__ == "__main__":
    sys.exit(main())
