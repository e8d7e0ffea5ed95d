"""One run of a method in a folder: the steps that the loops of `cloning`, `dart` and `dagger` take.

Every step writes its complete result into the folder, and is skipped if the result exists. So a
killed run is resumed by running its loop again.

    round_003/           see `rounds`
    held_out/            expert demonstrations that no policy learns from
    dataset/             all rounds' labels, once the run has ended
    metrics.jsonl        a line per round
    best/                the policy with the highest validation success; on a tie the latest
"""

import importlib
import itertools
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from manip_il.algorithms.results import Result, Stopwatch, best_result
from manip_il.algorithms.rounds import (
    DATASET,
    JOURNALS,
    REDRAWN,
    Fitted,
    Rollouts,
    begin_with,
    fit_round,
    given_rollouts,
    journal_ends,
    merge_rounds,
    read_rollouts,
    record_round,
    round_fit,
    round_folder,
    round_job,
    round_scenes,
)
from manip_il.collect.drivers import Driver, PolicyDriver
from manip_il.collect.edits import CHUNK, EditSource, EditTarget, redraw_dataset
from manip_il.collect.job import RolloutJob
from manip_il.collect.query import Query
from manip_il.collect.record import collect, demonstrate, provenance, seeds_by_task
from manip_il.collect.workers import Engine, default_workers
from manip_il.data.atomic import CHECKPOINT, append_line, new_folder, read_lines
from manip_il.data.build import Recording
from manip_il.data.dataset import Dataset
from manip_il.evaluation.measuring import measure
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.side import METRICS_FILE
from manip_il.learn.training_state import PRETRAINED_MODEL
from manip_il.progress import Progress
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import NOMINAL
from manip_il.sim.events import standard_in
from manip_il.worlds.table import task_names

BEST = "best"
HELD_OUT = "held_out"


class Run:
    """A run's folder, its workers, and its results so far.

    Args:
        config: A `RunConfig`, or, in the subclass of `manip_il.chapter.learning`, a
            `LearningConfig`.
        folder: The folder of the run.
        engine: The workers that simulate the episodes.
        progress: Follows the run.
    """

    def __init__(self, config: Any, folder: Path, engine: Engine, progress: Progress | None = None):
        self.config, self.folder = config, folder
        self._engine = engine
        self._progress = progress or Progress()
        self._clock = Stopwatch()
        self._made: dict[int, Rollouts] = {}
        self._held_out_steps = 0
        self._fitted: Fitted | None = None

    def results(self) -> Iterator[Result]:
        """Run or resume the loop of `config.method`, such as `dagger.dagger`, and yield its
        results.
        """
        name = self.config.method
        loop = getattr(importlib.import_module(f"manip_il.algorithms.{name}"), name)
        return self.follow(loop(self, self.config))

    def follow(self, results: Iterator[Result]) -> Iterator[Result]:
        """Yield the results of a method's loop until the loop ends or the label budget is spent.

        Rounds that were already finished are yielded again. At the end, `dataset` holds the labels
        of all rounds.
        """
        rounds, path = list[Result](), self.folder / METRICS_FILE
        written = {record.get("round", record.get("iteration")) for record in read_lines(path)}
        for result in results:
            # otherwise an interrupted run has written the line already
            if result.number not in written:
                append_line(path, result.to_json())
            yield result
            if result.unit == "round":
                rounds.append(result)
                if self._budget(result.number + 1) == 0:
                    break
        if rounds:
            best = best_result(rounds)
            self._keep_best(best.policy)
            made = [one.dataset for one in self._made.values() if one.dataset is not None]
            merge_rounds(made, self.folder / DATASET, best.number)

    def demonstrations(self, count: int, round_: int = 0) -> Rollouts:
        """Record a round of successful expert episodes.

        In round 0 `config.datasets` may replace them. A round whose dataset exists is read, not run
        again.

        Args:
            count: The number of successful episodes.
            round_: The number of the round.
        """
        here, config = self._folder(round_), self.config
        if round_ == 0 and (config.datasets or config.start):
            with self._clock.timed("collect"):
                self._made[0] = given_rollouts(here, config.datasets)
            return self._made[0]
        self._progress.start(f"round {round_}, collect", count)
        with self._clock.timed("collect"):
            if not (here / DATASET).is_dir():
                job = round_job(config, round_)
                stream = f"round/{round_}" if round_ else "demonstrations"
                episodes = demonstrate(
                    self._engine,
                    job,
                    stream,
                    count,
                    here / JOURNALS,
                    self._progress,
                    config.seed,
                )
                recording = Recording(True, count, provenance(job), labels=self._budget(round_))
                record_round(here, job, episodes, recording)
            self._made[round_] = read_rollouts(here, round_, beta=1.0)
        return self._made[round_]

    def held_out(self, count: int = 10) -> Path:
        """Record expert episodes that no policy learns from.

        Args:
            count: The number of episodes.

        Returns:
            The folder of their dataset.
        """
        root, journals = (self.folder / HELD_OUT / name for name in (DATASET, JOURNALS))
        with self._clock.timed("collect"):
            if not root.is_dir():
                job = replace(round_job(self.config, 0), cameras=None)
                episodes = collect(
                    self._engine, job, stream_seeds("held_out", count, self.config.seed), journals
                )
                recording = Recording(provenance=provenance(job))
                recording.write(journals)
                recording.make(episodes, root)
            self._held_out_steps = sum(length for length, _ in journal_ends(journals))
        return root

    def rollouts(
        self, round_: int, driver: Driver, query: Query | None = None, disturbed: float = 0.0
    ) -> Rollouts:
        """Record a round's episodes, successful or not, labelled in the mode `config.label`.

        A round whose dataset exists is read, not run again.

        Args:
            round_: The number of the round.
            driver: Chooses the actions.
            query: When the expert is queried; None for every state.
            disturbed: The share of the episodes that have the disturbances
                `manip_il.sim.events.STANDARD`.
        """
        here = self._folder(round_)
        config = self.config
        count = config.episodes_per_round
        self._progress.start(f"round {round_}, collect", count)
        with self._clock.timed("collect"):
            if not (here / DATASET).is_dir():
                job = round_job(
                    config, round_, driver=driver, label=config.label, query=query or Query()
                )
                if config.label == "branch":
                    job = replace(job, branch_steps=config.steps_of_branch)
                if job.labels_all:
                    job = replace(job, patience=config.patience)
                hard = replace(job, conditions=(standard_in(job.conditions),))
                seeds = self._seeds(round_)
                first = round(disturbed * count)
                episodes = itertools.chain.from_iterable(
                    collect(self._engine, one, part, here / JOURNALS, self._progress.episode)
                    for one, part in ((hard, seeds[:first]), (job, seeds[first:]))
                )
                recording = Recording(
                    provenance=provenance(job),
                    only_labelled=not job.labels_all,
                    labels=self._budget(round_),
                )
                record_round(here, job, episodes, recording)
            self._made[round_] = read_rollouts(here, round_, driver.beta)
        return self._made[round_]

    def fit(self, data: Sequence[Rollouts]) -> Fitted:
        """Fit the policy, or all members of an ensemble, to `data`, whose last rollouts are of
        the policy's round.
        """
        config = self.config
        before = self._fitted
        round_ = data[-1].round
        here, members = self._folder(round_), list[Path]()
        if config.start is not None and (round_ == 0 or all(one.dataset is None for one in data)):
            members.append(begin_with(config.start, here))
        else:
            roots = [
                self._training_dataset(one, one.dataset) for one in data if one.dataset is not None
            ]
            starts = (
                before.members if before and config.refit == "warm" else (None,) * config.ensemble
            )
            for member, start in enumerate(starts):
                name = "fit" if config.ensemble == 1 else f"fit {member + 1} of {config.ensemble}"
                fit = round_fit(config, start, member)
                self._progress.start(f"round {round_}, {name}", fit.total_steps)
                with self._clock.timed("fit"):
                    members.append(fit_round(roots, here, fit, member, self._progress.log))
        self._fitted = Fitted(round_, tuple(members), config.fit.trust)
        return self._fitted

    def validate(self, policy: Fitted) -> Result:
        """Evaluate a round's policy on the validation seeds; return the round's result."""
        round_, config = policy.round, self.config
        self._progress.start(f"round {round_}, validate", config.validation_episodes)
        driver = PolicyDriver.of(policy.path, trust=config.fit.trust)
        job = RolloutJob(
            config.env, driver, config.hold, label="last", conditions=config.conditions
        )
        validation = self._evaluate(job, self._folder(round_) / FILE_NAME, f"DAgger round {round_}")
        here = self._made[round_]
        so_far = [one for one in self._made.values() if one.round <= round_]
        return Result(
            unit="round",
            number=round_,
            steps=sum(one.steps for one in so_far) + self._held_out_steps,
            episodes=sum(one.episodes for one in so_far),
            metrics={
                "beta": here.beta,
                "labels": sum(one.labels for one in so_far),
                "rollout_success": here.successes / max(1, here.episodes),
            },
            policy=policy.path,
            validated=validation,
            seconds=self._clock.take(),
        )

    def _evaluate(self, job: RolloutJob, path: Path, name: str) -> EvalResult:
        """Evaluate a job on the validation seeds and write `path`, unless it exists. name:
        stored in the file.
        """
        with self._clock.timed("validate"):
            if path.is_file():
                return EvalResult.read(path)
            suite = job.conditions[0].name if job.conditions else NOMINAL.name
            seeds = stream_seeds("validation", self.config.validation_episodes, self.config.seed)
            found = measure(self._engine, job, seeds, name, self._progress, suite=suite)
            found.write(path)
            return found

    def _keep_best(self, policy: Path) -> None:
        """Copy the best policy's `pretrained_model` to `best`."""
        with new_folder(self.folder / BEST, replaces=CHECKPOINT) as new:
            shutil.copytree(policy, new / PRETRAINED_MODEL)

    def _seeds(self, round_: int) -> list[int]:
        """Return the seeds of a round's rollouts.

        With several tasks, each gets rollouts in proportion to its estimated share of failures: (f
        + 1) / (n + 2) if f of n episodes of the last validation failed (Laplace's rule of
        succession).
        """
        config, validated = self.config, self._folder(round_ - 1) / FILE_NAME
        parts = EvalResult.read(validated).by_task if validated.is_file() else {}
        outcomes = [
            [one.success for one in parts[str(name)].episodes] if name in parts else []
            for name in task_names(config.env)
        ]
        weights = [(one.count(False) + 1) / (len(one) + 2) for one in outcomes]
        stream, count = f"round/{round_}", config.episodes_per_round
        found = seeds_by_task(config.env, stream, count, config.seed, weights=weights)
        return sorted(seed for seeds, number in found for seed in seeds[:number])

    def _folder(self, round_: int) -> Path:
        return round_folder(self.folder, round_)

    def _budget(self, round_: int) -> int | None:
        """Labels that the budget still allows in a round; None without a budget."""
        if self.config.label_budget is None:
            return None
        spent = sum(one.labels for one in self._made.values() if one.round < round_)
        return max(0, self.config.label_budget - spent)

    def _training_dataset(self, rollouts: Rollouts, dataset: Path) -> Path:
        """The dataset that a round's policy learns from: the recorded one, or scenes redrawn
        from its states.
        """
        root = self._folder(rollouts.round) / REDRAWN
        if not self.config.redraw:
            return dataset
        if not root.is_dir():
            made = [
                one.dataset
                for one in self._made.values()
                if one.dataset and one.round <= rollouts.round
            ]
            scenes = round_scenes(self.config, made)
            self._progress.start(f"round {rollouts.round}, redraw", len(scenes.numbers[::CHUNK]))
            workers = min(self._engine.workers or default_workers(), default_workers())
            with self._clock.timed("redraw"):
                target = EditTarget(root, workers, on_piece=self._progress.step)
                redraw_dataset(EditSource(Dataset.open(dataset), self.config.env), scenes, target)
        return root
