"""The steps that cloning, DAgger and DART are made of, each of which is skipped if its result is there already.

round_003/journals/    every rollout, the moment it ended
round_003/dataset/     what is learnt from; missing if the expert gave no label
round_003/redrawn/     scenes drawn anew of its states, if policies learn from those
round_003/policy/      the fit; policy_1, ... of an ensemble
round_003/eval.json    the validation
held_out/              the expert's demonstrations that no policy learns from
best/, dataset/        the round with the highest validation success, and all rounds' labels, once the run has ended
"""

from __future__ import annotations

import itertools
import logging
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import override

from manip_il.algorithms.config import RunConfig, check_labels
from manip_il.algorithms.rounds import Fitted, Rollouts, fit_round, round_fit, round_folder
from manip_il.algorithms.run import Result, Run, Watch, best_result
from manip_il.collect.drivers import Driver, ExpertDriver, PolicyDriver
from manip_il.collect.edits import Source, Target, redraw_dataset
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Query
from manip_il.collect.record import MAX_TRIES, collect, collect_successes, journal_of, provenance, record
from manip_il.collect.scenes import CHUNK, Scenes
from manip_il.collect.workers import Engine, default_workers
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording, dataset_sha256, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.schema import LABEL_VALID
from manip_il.errors import NothingToLearnError
from manip_il.evaluation.results import FILE_NAME
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.events import standard_in

_LOG = logging.getLogger(__name__)
DATASET, HELD_OUT, JOURNALS, POLICY, REDRAWN = "dataset", "held_out", "journals", "policy", "redrawn"


def mixture(policy: Fitted, beta: float) -> PolicyDriver:
    """Execute the expert's label with probability beta in each step, else the learner's action (Ross et al. 2011)."""
    return PolicyDriver(policy.members, beta, policy.trust)


class ImitationRun(Run):
    """The steps of one run in `folder`. Raises `UsageError` for labels that the policy cannot learn from."""

    config: RunConfig

    def __init__(self, config: RunConfig, folder: Path, engine: Engine, watch: Watch | None = None):
        check_labels(config)
        super().__init__(config, folder, engine, watch)
        self._made: dict[int, Rollouts] = {}
        self._held_out_steps = 0
        self._fitted: Fitted | None = None

    def demonstrations(self, count: int, round_: int = 0) -> Rollouts:
        """Record `count` successful episodes of the expert as a round's; round 0 may be given, see `RunConfig`."""
        if round_ == 0 and (self.config.datasets or self.config.start):
            return self._given()
        self._watch.on_stage("collect", round_, count)
        with self._timed("collect"):
            if not self._is_recorded(round_):
                job, journals = self._job(round_), self._folder(round_) / JOURNALS
                stream = f"round/{round_}" if round_ else "demonstrations"
                seeds = stream_seeds(stream, MAX_TRIES * count, self.config.seed)
                episodes = collect_successes(self._engine, job, seeds, count, journals, self._watch.on_episode)
                recording = Recording(self._repo_id(round_), True, count, provenance(job), labels=self._left(round_))
                self._record(job, episodes, recording)
            return self._keep(round_, beta=1.0, queried_everywhere=True)

    def held_out(self, count: int = 10) -> Path:
        """Record episodes of the expert that no policy learns from; return their dataset."""
        root, journals = (self.folder / HELD_OUT / name for name in (DATASET, JOURNALS))
        with self._timed("collect"):
            if not root.is_dir():
                job = replace(self._job(0), cameras=None)
                episodes = collect(self._engine, job, stream_seeds("held_out", count, self.config.seed), journals)
                record(episodes, journals, root, job, Recording("local/held_out", provenance=provenance(job)))
            self._held_out_steps = sum(len(read_journal(path)[1]) for path in list_episodes(journals))
        return root

    def rollouts(self, round_: int, driver: Driver, query: Query | None = None, disturbed: float = 0.0) -> Rollouts:
        """Record a round's episodes, successful or not, with the expert's labels as `config.label` has them.

        query: when the expert is queried; None: in every state. disturbed: share of the episodes that run under
        `STANDARD` as well.
        """
        config, rule = self.config, query or Query()
        count = config.episodes_per_round
        self._watch.on_stage("collect", round_, count)
        with self._timed("collect"):
            if not self._is_recorded(round_):
                steps = config.steps_of_branch if config.label == "branch" else 1
                job = replace(self._job(round_), driver=driver, label=config.label, query=rule, branch_steps=steps)
                job = replace(job, patience=config.patience if job.labels_all else None)
                name, left = self._repo_id(round_), self._left(round_)
                recording = Recording(name, provenance=provenance(job), only_labelled=not job.labels_all, labels=left)
                self._record(job, self._collect(job, count, round(disturbed * count)), recording)
            return self._keep(round_, driver.beta, config.label == "per_state" and rule.kind in ("every", "safety"))

    def fit(self, data: Sequence[Rollouts]) -> Fitted:
        """Fit the policy, and the others of an ensemble after it, to rollouts; it belongs to the last one's round."""
        config, before, round_ = self.config, self._fitted, data[-1].round
        if config.start is not None and (round_ == 0 or all(one.dataset is None for one in data)):
            with self._timed("fit"):
                self._fitted = Fitted(round_, (self._take(config.start, round_),), config.fit.trust)
            return self._fitted
        roots = [self._learnt_from(one) for one in data if one.dataset is not None]
        starts = before.members if before and config.refit == "warm" else (None,) * config.ensemble
        members: list[Path] = []
        with self._timed("fit"):
            for member, start in enumerate(starts):
                name = "fit" if config.ensemble == 1 else f"fit {member + 1} of {config.ensemble}"
                fit, into = round_fit(config, start, member), f"{POLICY}_{member}" if member else POLICY
                self._watch.on_stage(name, round_, fit.total_steps)
                members.append(fit_round(config, roots, self._folder(round_) / into, fit, self._watch.on_log))
        self._fitted = Fitted(round_, tuple(members), config.fit.trust)
        return self._fitted

    def validate(self, policy: Fitted) -> Result:
        """Measure a round's policy on the validation's seeds, which ends the round."""
        round_, config = policy.round, self.config
        self._watch.on_stage("validate", round_, config.validation_episodes)
        driver = PolicyDriver((policy.path,), trust=config.fit.trust)
        job = RolloutJob(config.env, driver, config.hold, label="last", conditions=config.conditions)
        validation = self._validate(job, self._folder(round_) / FILE_NAME, f"DAgger round {round_}")
        here, so_far = self._made[round_], [one for one in self._made.values() if one.round <= round_]
        return Result(
            unit="round",
            number=round_,
            steps=sum(one.steps for one in so_far) + self._held_out_steps,
            episodes=sum(one.episodes for one in so_far),
            metrics={
                "beta": here.beta,
                "labels": sum(one.labels for one in so_far),
                # More than labels if it must answer to decide (`safety`, the held-out episodes of `dart`).
                "queries": sum(one.queries for one in so_far) + self._held_out_steps,
                "rollout_success": here.successes / max(1, here.episodes),
            },
            policy=policy.path,
            validated=validation,
            seconds=self._take_seconds(),
        )

    @override
    def follow(self, results: Iterator[Result]) -> Iterator[Result]:
        """Yield an algorithm's rounds, the finished ones again first, until it ends or the label budget is spent.

        Then `best/pretrained_model` holds the round with the highest validation success (the later of equals) and
        `dataset` the aggregated LeRobot dataset.
        """
        rounds: list[Result] = []
        for result in results:
            rounds.append(result)
            yield result
            if self._left(result.number + 1) == 0:
                break
        best, root = best_result(rounds), self.folder / DATASET
        self._keep_best(best.policy)
        made = [one.dataset for one in self._made.values() if one.dataset is not None]
        if made and not (root.is_dir() and _episodes(root) == sum(map(_episodes, made))):
            shutil.rmtree(root, ignore_errors=True)
            name = f"local/{self.config.env.name}_dagger"
            merge_datasets(made, root, repo_id=name, provenance={"best_round": best.number})

    def _folder(self, round_: int) -> Path:
        return round_folder(self.folder, round_)

    def _repo_id(self, round_: int) -> str:
        return f"local/{self.config.env.name}_round_{round_}"

    def _is_recorded(self, round_: int) -> bool:
        return (self._folder(round_) / DATASET).is_dir()

    def _job(self, round_: int) -> RolloutJob:
        """The expert's rollouts."""
        config = self.config
        cameras = None if config.redraw else config.cameras  # states are enough
        job = RolloutJob(config.env, ExpertDriver(), config.hold, round=round_, cameras=cameras)
        return replace(job, conditions=config.conditions)

    def _left(self, round_: int) -> int | None:
        """Labels that may still be had in a round; None without a limit."""
        if self.config.label_budget is None:
            return None
        had = sum(one.labels for one in self._made.values() if one.round < round_)
        return max(0, self.config.label_budget - had)

    def _collect(self, job: RolloutJob, count: int, disturbed: int) -> Iterator[tuple[Journal, Episode]]:
        """A round's episodes, of which the first `disturbed` are."""
        seeds = stream_seeds(f"round/{job.round}", count, self.config.seed)
        journals, on_episode = self._folder(job.round) / JOURNALS, self._watch.on_episode
        hard = replace(job, conditions=(standard_in(job.conditions),))
        return itertools.chain(
            collect(self._engine, hard, seeds[:disturbed], journals, on_episode),
            collect(self._engine, job, seeds[disturbed:], journals, on_episode),
        )

    def _record(self, job: RolloutJob, episodes: Iterator[tuple[Journal, Episode]], recording: Recording) -> None:
        """Run a round's episodes and write its dataset."""
        here = self._folder(job.round)
        for line in journal_of(here / JOURNALS, job).prepare():
            _LOG.warning("%s", line)
        try:
            record(episodes, here / JOURNALS, here / DATASET, job, recording)
        except NothingToLearnError:
            _LOG.warning("round %d: no labels, as the expert was queried in none of its rollouts", job.round)

    def _keep(self, round_: int, beta: float, queried_everywhere: bool) -> Rollouts:
        """Return what lies on disk of a round's rollouts."""
        here = self._folder(round_)
        episodes = (read_journal(path)[1] for path in list_episodes(here / JOURNALS))
        ends = [(len(episode), episode.success) for episode in episodes]
        dataset = here / DATASET if self._is_recorded(round_) else None
        labels = _count_labels(dataset) if dataset else 0
        steps = sum(length for length, _ in ends)
        queries = steps if queried_everywhere else labels
        successes = sum(success for _, success in ends)
        self._made[round_] = Rollouts(round_, dataset, beta, labels, queries, len(ends), successes, steps)
        return self._made[round_]

    def _given(self) -> Rollouts:
        """Return round 0 made of the datasets that were given, if any; they are copied into the run."""
        root, datasets = self._folder(0) / DATASET, self.config.datasets
        made = Rollouts(0)
        with self._timed("collect"):
            if datasets and not self._is_recorded(0):
                sources = {str(one): dataset_sha256(one) for one in datasets}
                merge_datasets(datasets, root, repo_id=self._repo_id(0), provenance={"given": sources})
            if datasets:
                given, labels = Dataset.open(root), _count_labels(root)
                successes = given.count_successes()
                made = Rollouts(0, root, 1.0, labels, labels, given.info.episodes, successes, len(given))
        self._made[0] = made
        return made

    def _take(self, policy: Path, round_: int) -> Path:
        """Copy a policy into a round that has nothing to fit; return its `pretrained_model`."""
        last = self._folder(round_) / POLICY / "checkpoints" / "last"
        if not last.is_dir():
            with new_folder(last) as new:
                shutil.copytree(policy, new / PRETRAINED_MODEL)
        return last / PRETRAINED_MODEL

    def _learnt_from(self, rollouts: Rollouts) -> Path:
        """The dataset that policies learn from of a round: its own, or scenes drawn anew of its states."""
        assert rollouts.dataset is not None
        config, root = self.config, self._folder(rollouts.round) / REDRAWN
        if not config.redraw or config.cameras is None:
            return rollouts.dataset
        if not root.is_dir():
            # As many scenes a state as round 0 gets, numbered on from those of the rounds before.
            made = [one.dataset for one in self._made.values() if one.dataset and one.round <= rollouts.round]
            states = [len(Dataset.open(dataset)) for dataset in made]
            *before, frames = [max(1, config.redraw * count // states[0]) for count in states]
            scenes = Scenes(config.cameras, frames, config.seed, conditions=config.conditions, first=sum(before))
            self._watch.on_stage("redraw", rollouts.round, len(scenes.numbers[::CHUNK]))
            workers = min(self._engine.workers or default_workers(), default_workers())
            with self._timed("redraw"):
                target = Target(root, workers, on_piece=self._watch.on_step)
                redraw_dataset(Source(Dataset.open(rollouts.dataset), config.env), scenes, target)
        return root


def _count_labels(root: Path) -> int:
    return int(Dataset.open(root).columns([LABEL_VALID])[LABEL_VALID].sum())


def _episodes(root: Path) -> int:
    return Dataset.open(root).info.episodes
