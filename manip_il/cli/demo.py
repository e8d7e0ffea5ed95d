"""`manip-il demo`: demonstrations, cloning, DAgger, and a report that compares them."""

from __future__ import annotations

import time
from collections.abc import Generator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.algorithms.config import RunConfig
from manip_il.cli import common_options as common
from manip_il.cli.dagger import DaggerOptions, learning_curve, round_timings, run_rounds
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say
from manip_il.learn.fit_config import FitConfig
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.algorithms.run import Result
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.report import Film, Report
    from manip_il.evaluation.results import EvalResult
    from manip_il.evaluation.runner import Trial
    from manip_il.evaluation.tables import PolicyRow

RUN = {"demonstrations": 100, "rounds": 3, "validation_episodes": 100}  # in place of `manip-il dagger`'s own
FIT = {"steps": 3_000, "batch_size": 256}
_OF_RUN = (*RUN, "episodes_per_round", "disturbed_share", "seed")
PLACE = "evaluation"
MORE = 2  # place of the policy that is cloned from as many labels, among the contestants
SUITES = {"nominal": "nominal", "disturbed": "knocked", "validation": "nominal"}  # by the folder of the evaluations


@dataclass
class DemoOptions:
    """Run a small complete example: the expert demonstrates, a policy is cloned, DAgger improves it.

    Compares the expert, the cloned policy, one cloned from as many labels as DAgger used, and DAgger's best round on
    the same unseen seeds, undisturbed and disturbed; OUTPUT_DIR/report.html shows it. The policy is an mlp: manip-il
    train and manip-il dagger take every other.
    """

    example: ClassVar[str] = "manip-il demo --output_dir=runs/demo"
    first: ClassVar[str] = "robot.type task.type rounds test_episodes output_dir resume"
    env: Given = common.env_given()
    settings: Given = given(RunConfig, prefix="", only=_OF_RUN, defaults=RUN)
    fit: Given = given(FitConfig, prefix="", only=("policy", "steps", "batch_size"), defaults=FIT)
    test_episodes: int = option(200, "unseen test episodes, used for no choice", at_least=1)
    disturbed_episodes: int = option(100, "the first of them again, disturbed", at_least=1)
    engine: common.EngineOptions = group(common.EngineOptions(), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/demo")), prefix="")

    def run(self) -> None:
        """Run what is not there yet, print the table, write the report."""
        settings, fit = RUN | self.settings, FIT | self.fit
        config = DaggerOptions(env=self.env, settings=settings, fit=fit, output=self.output).config()
        with self.output.open(self) as folder:
            kept = f"every finished episode, round and evaluation, in {folder}"
            with Stages(kept) as stages, self.engine.open() as engine:
                engine.warm_up(learned=True)
                _Demo(self, config, engine, stages).run()


@dataclass(frozen=True)
class Contestant:
    """One policy of the comparison; None is the expert. labels: expert labels that it learnt from."""

    key: str  # its folder
    name: str
    colour: str
    policy: Path | None = None
    labels: int | None = None


class _Demo:
    """One run of the demo: its parts one after the other, each of which skips what is done."""

    def __init__(self, options: DemoOptions, config: RunConfig, engine: Engine, stages: Stages) -> None:
        self.options, self.config, self.engine, self.stages = options, config, engine, stages
        self.folder = options.output.output_dir
        self.timings: dict[str, float] = {}  # of the parts [s], in this run

    def run(self) -> None:
        """Run every part, then print the table and write the report."""
        from manip_il.evaluation.rounds import format_seconds
        from manip_il.evaluation.tables import PolicyRow, policy_table, print_table

        with self._timed("demonstrations and DAgger"):
            results = run_rounds(self.config, self.folder / "dagger", self.engine, self.stages)
        with self._timed("cloning with as many labels"):
            contestants = self._contestants(results)
        with self._timed("evaluations"):
            measured = self._measure(contestants)
        with self._timed("films"):
            films = self._film(contestants, measured["nominal"])
        nominal, disturbed = measured["nominal"], measured["disturbed"]
        rows = [PolicyRow(w.name, nominal[w.key], w.labels, disturbed[w.key], w.colour) for w in contestants]
        report = self._report(contestants, rows, measured, films)
        report.write(self.folder / REPORT_FILE)
        print_table(policy_table(rows), empty="-")
        for sentence in (report.verdict, *report.facts):
            say(sentence)
        say(f"took {format_seconds(sum(self.timings.values()))} in all")
        say(f"report: {self.folder / REPORT_FILE}")
        say(
            f"next: manip-il eval --policy.path={contestants[-1].policy} --eval.films=3 --output_dir={self.folder}_eval"
        )

    def _contestants(self, results: list[Result]) -> list[Contestant]:
        from manip_il.algorithms.cloning import clone_with_labels
        from manip_il.algorithms.run import best_result
        from manip_il.evaluation.tables import CLONING, DAGGER, EXPERT

        first, best = results[0], best_result(results)
        watch = replace(
            self.stages.watch(),
            on_stage=lambda stage, _, total: self.stages.start(f"cloning with as many labels, {stage}", total),
        )
        dagger, folder = self.folder / "dagger", self.folder / "cloning"
        policy, labels = clone_with_labels(self.config, results[-1].labels, dagger, folder, self.engine, watch)
        return [
            Contestant("expert", "expert", EXPERT),
            Contestant("cloned", "cloning", CLONING, first.policy, first.labels),
            Contestant("cloned_more", "cloning, as many labels", CLONING, policy, labels),
            Contestant("dagger", f"DAgger (round {best.number})", DAGGER, best.policy, best.labels),
        ]

    def _trial(self, folder: str, seeds: range) -> Trial:
        from manip_il.evaluation.runner import Trial

        return Trial.of(self.config.env, seeds, SUITES[folder])

    def _measure(self, contestants: Sequence[Contestant]) -> dict[str, dict[str, EvalResult]]:
        """Return folder -> policy -> evaluation; those of an interrupted run are read."""
        from manip_il.seeding import stream_seeds

        measured: dict[str, dict[str, EvalResult]] = {}
        for folder, stream, count, some in (
            ("nominal", "test", self.options.test_episodes, contestants),
            ("disturbed", "test", self.options.disturbed_episodes, contestants),
            ("validation", "validation", self.config.validation_episodes, [contestants[MORE]]),
        ):
            trial, place = (
                self._trial(folder, stream_seeds(stream, count, self.config.seed)),
                self.folder / "evaluation",
            )
            last = (self.engine, self.stages)
            measured[folder] = {
                one.key: trial.measure(one.policy, one.name, place / folder / one.key, *last) for one in some
            }
        return measured

    def _film(self, contestants: Sequence[Contestant], results: Mapping[str, EvalResult]) -> tuple[list[Film], str]:
        """Film every policy on the first seed on which DAgger succeeds and cloning fails, else the first of all."""
        from manip_il.evaluation.film import Shot, film_shots, run_states

        won = {episode.seed for episode in results["dagger"].episodes if episode.success}
        lost = [episode.seed for episode in results["cloned"].episodes if not episode.success]
        seed = next((seed for seed in lost if seed in won), results["cloned"].episodes[0].seed)
        trial = self._trial("nominal", range(seed, seed + 1))
        shots: list[Shot] = []
        for one in contestants:
            job = trial.job(one.policy)
            episode = run_states(job, seed)
            caption = f"{'success' if episode.success else 'failure'}, seed {seed}"
            shots.append(Shot(job, episode, one.name, caption, stills=6))
        self.stages.start("films", len(shots))
        return film_shots(shots, self.stages)

    def _report(
        self,
        contestants: Sequence[Contestant],
        rows: Sequence[PolicyRow],
        measured: Mapping[str, Mapping[str, EvalResult]],
        films: tuple[list[Film], str],
    ) -> Report:
        from manip_il.evaluation.eval_report import run_report
        from manip_il.evaluation.figures import Curve
        from manip_il.evaluation.results import compare_results
        from manip_il.evaluation.rounds import Round

        _, cloned, more, dagger = contestants
        nominal, disturbed = measured["nominal"], measured["disturbed"]
        facts = [
            f"{words}: {compare_results(results[one.key], results[dagger.key], (one.name, dagger.name)).verdict}"
            for words, results in (("Undisturbed", nominal), ("Disturbed", disturbed))
            for one in (cloned, more)
        ]
        success = measured["validation"][more.key].success
        beside = Curve("cloning", ((Round(0, more.labels or 0, 0, 0, 0.0, success),),), more.colour, ("labels",))
        return run_report(
            rows,
            *films,
            [learning_curve(self.folder / "dagger"), beside],
            title=f"Demo: {self.config.env.robot} {self.config.env.task}",
            verdict=demo_verdict(rows, compare_results(nominal[more.key], nominal[dagger.key]).significant),
            command=command_line("demo", self.options),
            facts=(
                *facts,
                f"{self.config.disturbed_share:.0%} of DAgger's rollouts were disturbed, no demonstration was.",
            ),
            config=to_plain(self.options),
            fingerprint=nominal[dagger.key].fingerprint,
            timings=self.timings | round_timings(self.folder / "dagger"),
        )

    @contextmanager
    def _timed(self, part: str) -> Generator[None]:
        started = time.monotonic()
        yield
        self.timings[part] = time.monotonic() - started


def demo_verdict(rows: Sequence[PolicyRow], significant: bool) -> str:
    """Return the report's first sentence; significant: whether DAgger differs from cloning with as many labels."""
    from manip_il.evaluation.intervals import format_percent

    _, cloned, more, dagger = rows
    return (
        f"DAgger solves {format_percent(dagger.success.rate)} of {dagger.success.n:,} unseen starts, "
        f"cloning {format_percent(more.success.rate)} with as many labels "
        f"and {format_percent(cloned.success.rate)} with the first demonstrations alone."
        + ("" if significant else " So few starts show no difference between DAgger and cloning with as many labels.")
    )
