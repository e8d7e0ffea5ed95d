"""The parts of a round of imitation: its rollouts, and the policy that is fitted to those of all rounds.

round_003/journals/    every rollout, the moment it ended
round_003/dataset/     what is learnt from; missing if the expert gave no label
round_003/redrawn/     scenes drawn anew of its states, if policies learn from those
round_003/policy/      the fit; policy_1, ... of an ensemble
round_003/eval.json    the validation
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.algorithms.config import RunConfig
from manip_il.collect.drivers import ExpertDriver, PolicyDriver
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import journal_of
from manip_il.collect.scenes import Scenes
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording, dataset_sha256, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.schema import LABEL_VALID
from manip_il.errors import NothingToLearnError
from manip_il.learn.fit_config import LEROBOT, FitConfig
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_base

_LOG = logging.getLogger(__name__)
CHUNK_STEPS = 20_000  # of a round, for LeRobot's policies, if none are given
DATASET, JOURNALS, POLICY, REDRAWN = "dataset", "journals", "policy", "redrawn"


@dataclass(frozen=True)
class Rollouts:
    """One round's episodes. dataset: None if the expert gave no label. beta: the expert's share of the steps.

    labels: sound ones. queries: states in which the expert was queried. episodes, successes: of the rollouts. steps:
    control steps simulated.
    """

    round: int
    dataset: Path | None = None
    beta: float = 1.0
    labels: int = 0
    queries: int = 0
    episodes: int = 0
    successes: int = 0
    steps: int = 0


@dataclass(frozen=True)
class Fitted:
    """A round's policy. members: the `pretrained_model` folders of an ensemble, of which the first drives.

    trust: whether models that they name may be loaded.
    """

    round: int
    members: tuple[Path, ...]
    trust: bool = False

    @property
    def path(self) -> Path:
        """Return the checkpoint of the policy that drives."""
        return self.members[0]


def round_folder(folder: Path, round_: int) -> Path:
    """Return the folder of a round: its journals, dataset, policy and evaluation."""
    return folder / f"round_{round_:03d}"


def mixture(policy: Fitted, beta: float) -> PolicyDriver:
    """Execute the expert's label with probability beta in each step, else the learner's action (Ross et al. 2011)."""
    return PolicyDriver(policy.members, beta, policy.trust)


def expert_job(config: RunConfig, round_: int) -> RolloutJob:
    """Return the expert's rollouts."""
    cameras = None if config.redraw else config.cameras  # states are enough
    job = RolloutJob(config.env, ExpertDriver(), config.hold, round=round_, cameras=cameras)
    return replace(job, conditions=config.conditions)


def record_round(
    folder: Path, job: RolloutJob, episodes: Iterator[tuple[Journal, Episode]], recording: Recording
) -> None:
    """Run a round's episodes in its folder, and write their dataset."""
    for line in journal_of(folder / JOURNALS, job).prepare():
        _LOG.warning("%s", line)
    try:
        recording.write(folder / JOURNALS)
        recording.make(episodes, folder / DATASET)
    except NothingToLearnError:
        _LOG.warning("round %d: no labels, as the expert was queried in none of its rollouts", job.round)


def read_rollouts(folder: Path, round_: int, beta: float, *, queried_everywhere: bool) -> Rollouts:
    """Return what lies on disk of a round's rollouts."""
    episodes = (read_journal(path)[1] for path in list_episodes(folder / JOURNALS))
    ends = [(len(episode), episode.success) for episode in episodes]
    dataset = folder / DATASET if (folder / DATASET).is_dir() else None
    labels = _count_labels(dataset) if dataset else 0
    steps = sum(length for length, _ in ends)
    queries = steps if queried_everywhere else labels
    successes = sum(success for _, success in ends)
    return Rollouts(round_, dataset, beta, labels, queries, len(ends), successes, steps)


def given_rollouts(folder: Path, datasets: Sequence[Path], repo_id: str) -> Rollouts:
    """Return round 0 made of the datasets that were given, if any; they are copied into the run."""
    root = folder / DATASET
    if not datasets:
        return Rollouts(0)
    if not root.is_dir():
        sources = {str(one): dataset_sha256(one) for one in datasets}
        merge_datasets(datasets, root, repo_id=repo_id, provenance={"given": sources})
    given, labels = Dataset.open(root), _count_labels(root)
    return Rollouts(0, root, 1.0, labels, labels, given.info.episodes, given.count_successes(), len(given))


def merge_rounds(datasets: Sequence[Path], root: Path, repo_id: str, best: int) -> None:
    """Write all rounds' labels as one dataset, unless it is there. best: round, which it names."""

    def episodes(dataset: Path) -> int:
        return Dataset.open(dataset).info.episodes

    if datasets and not (root.is_dir() and episodes(root) == sum(map(episodes, datasets))):
        shutil.rmtree(root, ignore_errors=True)
        merge_datasets(datasets, root, repo_id=repo_id, provenance={"best_round": best})


def _count_labels(root: Path) -> int:
    return int(Dataset.open(root).columns([LABEL_VALID])[LABEL_VALID].sum())


def round_scenes(config: RunConfig, datasets: Sequence[Path]) -> Scenes:
    """Return the scenes drawn anew of the states of the last of the rounds' datasets.

    As many a state as of round 0's, numbered on from those of the rounds before.
    """
    assert config.cameras is not None
    states = [len(Dataset.open(dataset)) for dataset in datasets]
    *before, frames = [max(1, config.redraw * count // states[0]) for count in states]
    return Scenes(config.cameras, frames, config.seed, conditions=config.conditions, first=sum(before))


def begin_with(policy: Path, folder: Path) -> Path:
    """Copy a policy into the folder of a round that has nothing to fit; return its `pretrained_model`."""
    last = folder / POLICY / "checkpoints" / "last"
    if not last.is_dir():
        with new_folder(last) as new:
            shutil.copytree(policy, new / PRETRAINED_MODEL)
    return last / PRETRAINED_MODEL


def fit_round(
    roots: Sequence[Path], folder: Path, fit: FitConfig, member: int, on_log: Callable[[dict[str, Any]], None]
) -> Path:
    """Fit, or go on with fitting, a policy of a round to datasets; return the checkpoint's `pretrained_model`.

    member: of the ensemble. on_log: sees the metrics, {} at a step without.
    """
    from manip_il.learn.train import Trainer  # torch stays out of what only rolls out

    into = folder / (f"{POLICY}_{member}" if member else POLICY)
    return Trainer([*map(Dataset.open, roots)], fit, into, resume=True).fit(on_log)


def round_fit(config: RunConfig, init_from: Path | None = None, member: int = 0) -> FitConfig:
    """Return the options of one round's fit. init_from: where a warm one starts from.

    Any other starts from the run's start policy, if there is one. member: of the ensemble, each from a seed of its own.
    """
    steps = config.fit.steps or (CHUNK_STEPS if config.fit.defaults is LEROBOT else None)
    if init_from is not None:
        steps = config.refit_steps or steps
    seed = stream_base("training", config.seed) + member
    return replace(config.fit, steps=steps, seed=seed, init_from=init_from or config.start)
