"""The parts of an imitation round: its rollouts, and the policy that is fitted to the rollouts of
all rounds.

round_003/journals/    every rollout, written as soon as it ends
round_003/dataset/     the training data; missing if the expert gave no label
round_003/redrawn/     scenes redrawn from the dataset's states, with --redraw: what is learnt from
round_003/policy/      the fit; the other members of an ensemble are policy_1, ...
round_003/eval.json    the validation
"""

import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.algorithms.config import RunConfig
from manip_il.collect.drivers import PolicyDriver
from manip_il.collect.edits import Scenes
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import journal_of
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording, dataset_sha256, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.schema import LABEL_VALID
from manip_il.errors import NothingToLearnError, warn
from manip_il.learn.fit_config import LEROBOT, FitConfig
from manip_il.learn.train import Trainer
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_base
from manip_il.worlds.table import env_spec

CHUNK_STEPS = 20_000  # default gradient steps per round for LeRobot's policies
DATASET = "dataset"
JOURNALS = "journals"
POLICY = "policy"
REDRAWN = "redrawn"


@dataclass(frozen=True)
class Rollouts:
    """One round's episodes.

    Attributes:
        round: The number of the round.
        dataset: The folder of the training data; None if the expert gave no label.
        beta: The expert's share of the steps.
        labels: Number of valid labels.
        episodes: Number of rollouts.
        successes: Number of successful rollouts.
        steps: Simulated control steps.
    """

    round: int
    dataset: Path | None = None
    beta: float = 1.0
    labels: int = 0
    episodes: int = 0
    successes: int = 0
    steps: int = 0


@dataclass(frozen=True)
class Fitted:
    """A round's policy.

    Attributes:
        round: The number of the round.
        members: The `pretrained_model` folders of an ensemble, the first of which drives.
        trust: Whether to load models that a checkpoint names.
    """

    round: int
    members: tuple[Path, ...]
    trust: bool = False

    @property
    def path(self) -> Path:
        """Checkpoint of the policy that drives."""
        return self.members[0]


def round_folder(folder: Path, round_: int) -> Path:
    """Return the folder of a round: its journals, dataset, policy and evaluation."""
    return folder / f"round_{round_:03d}"


def mixture(policy: Fitted, beta: float) -> PolicyDriver:
    """Return a driver: at each step the expert acts with probability beta, else the learner
    (Ross et al. 2011).
    """
    return PolicyDriver.of(*policy.members, beta=beta, trust=policy.trust)


def round_job(config: RunConfig, round_: int, **more: Any) -> RolloutJob:
    """Return the job of a round's rollouts, by default of the expert's. more: other fields of
    `RolloutJob`.
    """
    cameras = None if config.redraw else config.cameras  # redrawing needs states only
    return RolloutJob(
        config.env,
        hold=config.hold,
        round=round_,
        cameras=cameras,
        conditions=config.conditions,
        **more,
    )


def record_round(
    folder: Path, job: RolloutJob, episodes: Iterator[tuple[Journal, Episode]], recording: Recording
) -> None:
    """Run a round's episodes in its folder, and write their dataset.

    If the expert was never queried, no dataset is written.

    Args:
        folder: The folder of the round.
        job: The job of the rollouts.
        episodes: The journal and the episode of each rollout; iterating over it runs the rollouts.
        recording: How the dataset is made from the rollouts.
    """
    journal_of(folder / JOURNALS, job).prepare()
    try:
        recording.write(folder / JOURNALS)
        recording.make(episodes, folder / DATASET)
    except NothingToLearnError:
        warn(f"round {job.round}: no labels, because the expert was never queried")


def read_rollouts(folder: Path, round_: int, beta: float) -> Rollouts:
    """Return a round's rollouts as found on disk.

    Args:
        folder: The folder of the round.
        round_: The number of the round.
        beta: The share of the steps that the expert drove.
    """
    ends = journal_ends(folder / JOURNALS)
    dataset = folder / DATASET if (folder / DATASET).is_dir() else None
    return Rollouts(
        round_,
        dataset,
        beta,
        labels=_count_labels(Dataset.open(dataset)) if dataset else 0,
        episodes=len(ends),
        successes=sum(success for _, success in ends),
        steps=sum(length for length, _ in ends),
    )


def journal_ends(journals: Path) -> list[tuple[int, bool]]:
    """Return the length and the success of every episode in a folder of journals."""
    episodes = (read_journal(path)[1] for path in list_episodes(journals))
    return [(len(episode), episode.success) for episode in episodes]


def given_rollouts(folder: Path, datasets: Sequence[Path]) -> Rollouts:
    """Return round 0 with the given datasets, if any; they are copied into the run."""
    root = folder / DATASET
    if not datasets:
        return Rollouts(0)
    if not root.is_dir():
        sources = {str(one): dataset_sha256(one) for one in datasets}
        merge_datasets(datasets, root, provenance={"given": sources})
    given = Dataset.open(root)
    labels = _count_labels(given)
    return Rollouts(0, root, 1.0, labels, given.info.episodes, given.count_successes(), len(given))


def merge_rounds(datasets: Sequence[Path], root: Path, best: int) -> None:
    """Write all rounds' labels as one dataset, unless it exists.

    Args:
        datasets: The datasets of the rounds; if there are none, nothing is written.
        root: The folder of the merged dataset.
        best: The number of the best round, for the provenance.
    """
    made = sum(Dataset.open(one).info.episodes for one in datasets)
    if datasets and not (root.is_dir() and Dataset.open(root).info.episodes == made):
        merge_datasets(datasets, root, provenance={"best_round": best}, replace=True)


def _count_labels(dataset: Dataset) -> int:
    return int(dataset.columns([LABEL_VALID])[LABEL_VALID].sum())


def round_scenes(config: RunConfig, datasets: Sequence[Path]) -> Scenes:
    """Return the scenes to redraw from the states of the last dataset.

    There are as many scenes per state as in round 0. Scene numbers continue from the earlier
    rounds. Where nothing can be drawn anew, they are the states as visited.
    """
    assert config.cameras is not None
    states = [len(Dataset.open(dataset)) for dataset in datasets]
    *before, frames = [max(1, config.redraw * count // states[0]) for count in states]
    return Scenes(
        config.cameras,
        frames,
        config.seed,
        anew="redrawn" in env_spec(config.env).can,
        conditions=config.conditions,
        first=sum(before),
    )


def begin_with(policy: Path, folder: Path) -> Path:
    """Copy a policy into the folder of a round without training data.

    Args:
        policy: The `pretrained_model` folder of the policy.
        folder: The folder of the round.

    Returns:
        The copy's `pretrained_model` folder.
    """
    last = folder / POLICY / "checkpoints" / "last"
    if not last.is_dir():
        with new_folder(last) as new:
            shutil.copytree(policy, new / PRETRAINED_MODEL)
    return last / PRETRAINED_MODEL


def fit_round(
    roots: Sequence[Path],
    folder: Path,
    fit: FitConfig,
    member: int,
    on_log: Callable[[dict[str, Any]], None],
) -> Path:
    """Fit a round's policy to datasets, or resume the fit.

    Args:
        roots: The folders of the datasets.
        folder: The folder of the round.
        fit: The options of the fit.
        member: The policy's index in the ensemble.
        on_log: Called after each step with its metrics, or with {} if there are none.

    Returns:
        The last checkpoint's `pretrained_model` folder.
    """
    into = folder / (f"{POLICY}_{member}" if member else POLICY)
    return Trainer([*map(Dataset.open, roots)], fit, into, resume=True).fit(on_log)


def round_fit(config: RunConfig, init_from: Path | None = None, member: int = 0) -> FitConfig:
    """Return the options of one round's fit.

    Args:
        config: The options of the run.
        init_from: The policy from which a warm fit starts. If None, the fit starts from the run's
            start policy, if there is one.
        member: The policy's index in the ensemble; each member has its own seed.
    """
    steps = config.fit.steps or (CHUNK_STEPS if config.fit.defaults is LEROBOT else None)
    if init_from is not None:
        steps = config.refit_steps or steps
    seed = stream_base("training", config.seed) + member
    return replace(config.fit, steps=steps, seed=seed, init_from=init_from or config.start)
