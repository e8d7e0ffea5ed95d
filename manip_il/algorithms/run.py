"""One run on disk: the steps that algorithms are made of, each of which is skipped where its result is there already.

round_003/journals/    every rollout, the moment it ended
round_003/dataset/     what is learnt from; missing where the expert gave no label
round_003/redrawn/     scenes drawn anew of its states, where policies learn from those
round_003/policy/      the fit; policy_1, ... of an ensemble
round_003/eval.json    the validation
held_out/              the expert's demonstrations that no policy learns from
best/, dataset/        the round with the highest validation success, and all rounds' labels, once the run has ended

Everything appears there whole, so that a run that was killed goes on where it was: an episode, a fit's last
checkpoint, or an evaluation that is there is not made again.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import time
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.algorithms.config import RunConfig, check_labels
from manip_il.algorithms.fitting import fit_round, round_fit
from manip_il.algorithms.rounds import Fitted, Rollouts, RoundResult, best_round
from manip_il.collect.drivers import Driver, ExpertDriver, PolicyDriver
from manip_il.collect.edits import Source, Target, redraw_dataset
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Query
from manip_il.collect.record import MAX_TRIES, collect, collect_successes, journal_of, provenance, record
from manip_il.collect.scenes import CHUNK, Scenes
from manip_il.collect.workers import Engine, default_workers
from manip_il.data import schema
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording, dataset_sha256, merge_datasets
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.errors import MismatchError, NothingToLearnError
from manip_il.evaluation.results import FILE_NAME, EpisodeResult, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL
from manip_il.sim.events import standard_in

_LOG = logging.getLogger(__name__)
BEST, DATASET, HELD_OUT, JOURNALS, POLICY = "best", "dataset", "held_out", "journals", "policy"
REDRAWN = "redrawn"


@dataclass(frozen=True)
class Watch:
    """Functions that a run calls with its progress. An exception from one ends the run; what is on disk stays."""

    on_stage: Callable[[str, int, int], None] = lambda stage, round_, total: None
    on_episode: Callable[[Episode | EpisodeResult], None] = lambda episode: None
    on_log: Callable[[dict[str, Any]], None] = lambda record: None  # {} at a step without metrics
    on_step: Callable[[], None] = lambda: None  # of anything else


class Run:
    """The steps of one run in `folder`. Raises `UsageError` for labels that the policy cannot learn from."""

    def __init__(self, config: RunConfig, folder: Path, engine: Engine, watch: Watch | None = None):
        check_labels(config)
        self.config, self.folder = config, folder
        self._engine, self._watch = engine, watch or Watch()
        self._made: dict[int, Rollouts] = {}
        self._held_out_steps = 0
        self._fitted: Fitted | None = None
        self._seconds: dict[str, float] = {}

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
        count, per_state = config.episodes_per_round, config.label == "per_state"
        self._watch.on_stage("collect", round_, count)
        with self._timed("collect"):
            if not self._is_recorded(round_):
                steps = config.steps_of_branch if config.label == "branch" else 1
                job = replace(self._job(round_), driver=driver, label=config.label, query=rule, branch_steps=steps)
                job = replace(job, patience=config.patience if job.labels_all else None)
                gated, name = not job.labels_all, self._repo_id(round_)
                left = self._left(round_)
                recording = Recording(name, provenance=provenance(job), only_labelled=gated, labels=left)
                self._record(job, self._collect(job, count, round(disturbed * count)), recording)
            return self._keep(round_, driver.beta, per_state and rule.kind in ("every", "safety"))

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
                self._watch.on_stage(name, round_, round_fit(config, start).total_steps)
                into = self._folder(round_) / (f"{POLICY}_{member}" if member else POLICY)
                members.append(fit_round(config, roots, into, start, self._watch.on_log, member))
        self._fitted = Fitted(round_, tuple(members), config.fit.trust)
        return self._fitted

    def _learnt_from(self, rollouts: Rollouts) -> Path:
        """The dataset that policies learn from of a round: its own, or scenes drawn anew of its states."""
        assert rollouts.dataset is not None
        config, root = self.config, self._folder(rollouts.round) / REDRAWN
        if not config.redraw or config.cameras is None:
            return rollouts.dataset
        if not root.is_dir():
            frames, first = self._scenes(rollouts.round)
            scenes = Scenes(config.cameras, frames, config.seed, conditions=config.conditions, first=first)
            self._watch.on_stage("redraw", rollouts.round, len(scenes.numbers[::CHUNK]))
            workers = min(self._engine.workers or default_workers(), default_workers())
            with self._timed("redraw"):
                target = Target(root, workers, on_piece=self._watch.on_step)
                redraw_dataset(Source(Dataset.open(rollouts.dataset), config.env), scenes, target)
        return root

    def _scenes(self, round_: int) -> tuple[int, int]:
        """How many scenes a round gets, as many a state as round 0's, and the number of the first."""
        made = [one.dataset for one in self._made.values() if one.dataset is not None and one.round <= round_]
        states = [len(Dataset.open(dataset)) for dataset in made]
        counts = [max(1, self.config.redraw * count // states[0]) for count in states]
        return counts[-1], sum(counts[:-1])

    def validate(self, policy: Fitted) -> RoundResult:
        """Measure a round's policy on the validation's seeds, which ends the round."""
        round_, path = policy.round, self._folder(policy.round) / FILE_NAME
        self._watch.on_stage("validate", round_, self.config.validation_episodes)
        with self._timed("validate"):
            validation = EvalResult.read(path) if path.is_file() else self._evaluate(policy, path)
        seconds, self._seconds = self._seconds, {}
        here, so_far = self._made[round_], [one for one in self._made.values() if one.round <= round_]
        return RoundResult(
            round=round_,
            beta=here.beta,
            labels=sum(one.labels for one in so_far),
            queries=sum(one.queries for one in so_far) + self._held_out_steps,
            episodes=sum(one.episodes for one in so_far),
            steps=sum(one.steps for one in so_far) + self._held_out_steps,
            rollout_success=here.successes / max(1, here.episodes),
            policy=policy.path,
            validation=validation,
            seconds={stage: round(took, 2) for stage, took in seconds.items()},
        )

    def follow(self, rounds: Iterator[RoundResult]) -> Iterator[RoundResult]:
        """Yield an algorithm's rounds, the finished ones again first, until it ends or the label budget is spent.

        Then `best/pretrained_model` holds the round with the highest validation success (the later of equals) and
        `dataset` the aggregated LeRobot dataset.
        """
        results: list[RoundResult] = []
        for result in rounds:
            results.append(result)
            yield result
            if self._left(result.round + 1) == 0:
                break
        if results:
            self._finish(best_round(results))

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
        """Labels that may still be had in a round; None where there is no limit."""
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

    def _given(self) -> Rollouts:
        """Return round 0 made of the datasets that were given, if any; they are copied into the run."""
        root, datasets = self._folder(0) / DATASET, self.config.datasets
        if not datasets:
            self._seconds["collect"] = 0.0
            self._made[0] = Rollouts(0, None, 1.0, labels=0, queries=0, episodes=0, successes=0, steps=0)
            return self._made[0]
        found = {str(one): dataset_sha256(one) for one in datasets}
        with self._timed("collect"):
            if not self._is_recorded(0):
                merge_datasets(datasets, root, repo_id=self._repo_id(0), provenance={"given": found})
        for (one, ours), theirs in zip(
            found.items(), Dataset.open(root).provenance.get("given", {}).values(), strict=True
        ):
            if ours != theirs:
                raise MismatchError("content of a dataset", one, ours, f"the run in {self.folder}", theirs)
        info = Dataset.open(root).summary
        labels = _count_labels(root)
        self._made[0] = Rollouts(0, root, 1.0, labels, labels, info.episodes, info.success or 0, info.frames)
        return self._made[0]

    def _take(self, policy: Path, round_: int) -> Path:
        """Copy a policy into a round that has nothing to fit; return its `pretrained_model`."""
        last = self._folder(round_) / POLICY / "checkpoints" / "last"
        if not last.is_dir():
            with new_folder(last) as new:
                shutil.copytree(policy, new / PRETRAINED_MODEL)
        return last / PRETRAINED_MODEL

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

    def _evaluate(self, policy: Fitted, path: Path) -> EvalResult:
        config = self.config
        driver = PolicyDriver((policy.path,), trust=config.fit.trust)
        job = RolloutJob(
            config.env, driver, config.hold, label="last", conditions=config.conditions
        )  # solved is solved
        seeds = stream_seeds("validation", config.validation_episodes, config.seed)
        suite, name = next((one.name for one in job.conditions), NOMINAL.name), f"DAgger round {policy.round}"
        result = evaluate(self._engine, job, seeds, name, self._watch.on_episode, suite=suite)
        result.write(path)
        return result

    def _finish(self, best: RoundResult) -> None:
        shutil.rmtree(self.folder / BEST, ignore_errors=True)
        with new_folder(self.folder / BEST) as new:
            shutil.copytree(best.policy, new / PRETRAINED_MODEL)
        root, config = self.folder / DATASET, self.config
        rounds = [one.dataset for one in self._made.values() if one.dataset is not None]
        if not rounds:
            return
        if root.is_dir() and _episodes(root) == sum(map(_episodes, rounds)):
            return
        shutil.rmtree(root, ignore_errors=True)
        name = f"local/{config.env.robot}_{config.env.task}_dagger"
        merge_datasets(rounds, root, repo_id=name, provenance={"best_round": best.round})

    @contextmanager
    def _timed(self, stage: str) -> Generator[None]:
        """Add what a stage takes to the round's seconds."""
        started = time.monotonic()
        yield
        self._seconds[stage] = self._seconds.get(stage, 0.0) + time.monotonic() - started


def _count_labels(root: Path) -> int:
    return int(Dataset.open(root).columns([schema.LABEL_VALID])[schema.LABEL_VALID].sum())


def _episodes(root: Path) -> int:
    return Dataset.open(root).info.episodes


def round_folder(folder: Path, round_: int) -> Path:
    """Return the folder of a round: its journals, dataset, policy and evaluation."""
    return folder / f"round_{round_:03d}"
