"""`manip-il quickstart`: demonstrations, cloning, DAgger, and a report that compares them."""

from __future__ import annotations

import json
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il import checks
from manip_il.cli.dagger import FREE, REPORT_FILE, DaggerOptions, learning_curve, round_timings, run_rounds
from manip_il.cli.folders import atomic_write, prepare_output
from manip_il.cli.groups import (
    ENGINE_HELP,
    WORKERS_HELP,
    EnvGroup,
    PolicyGroup,
    RobotGroup,
    TaskGroup,
    check_same_options,
    command_line,
    option,
    save_options,
    warn,
)
from manip_il.cli.options import to_plain
from manip_il.cli.paths import require_output
from manip_il.cli.progress import say
from manip_il.errors import UsageError

if TYPE_CHECKING:
    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.rounds import RoundResult
    from manip_il.cli.stages import Stages
    from manip_il.cli.story import Contestant, Pictures
    from manip_il.engine.engine import Engine
    from manip_il.evaluation.report import RunReport
    from manip_il.evaluation.report_data import PolicyRow
    from manip_il.evaluation.results import EvalResult

    Measured = dict[str, dict[str, EvalResult]]

TIMINGS_FILE = "timings.json"


@dataclass
class QuickstartOptions:
    """Run a small complete example: the expert demonstrates, a policy is cloned, DAgger improves it.

    Compares the expert, the cloned policy, one cloned from as many labels as DAgger used, and DAgger's best round on
    the same unseen seeds, undisturbed and disturbed; OUTPUT_DIR/report.html shows it.
    """

    example: ClassVar[str] = "manip-il quickstart --output_dir=runs/quickstart"
    robot: RobotGroup = field(default_factory=RobotGroup)
    task: TaskGroup = field(default_factory=TaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    demonstrations: int = option(100, "successful expert episodes to begin with")
    rounds: int = option(3, "of DAgger")
    episodes_per_round: int = option(50, "rollouts per round")
    disturbed_share: float = option(
        0.5, "share of a round's rollouts that are disturbed: object knocked, noisy actions"
    )
    policy: PolicyGroup = field(default_factory=PolicyGroup)
    steps: int = option(3_000, "gradient steps per fit")
    batch_size: int = option(512, "frames per step")
    validation_episodes: int = option(100, "unseen episodes that choose the best round")
    test_episodes: int = option(200, "unseen test episodes, used for no choice")
    disturbed_episodes: int = option(100, "the first of them again, disturbed")
    seed: int = option(0, "shifts every random stream, 0 to 1000")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    output_dir: Path = field(default=Path("runs/quickstart"), metadata={"help": "folder of the run"})
    resume: bool = option(False, "continue an interrupted run")
    overwrite: bool = option(False, "replace an existing run")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        for name in ("test_episodes", "disturbed_episodes"):
            if getattr(self, name) < 1:
                raise UsageError(f"--{name} is {getattr(self, name)}; expected at least 1")
        require_output(self.output_dir, "quickstart", resume=self.resume, overwrite=self.overwrite)
        replace(self._dagger(), output_dir=self.output_dir, resume=self.resume, overwrite=self.overwrite).check()

    def run(self) -> None:
        """Run what is not there yet, print the table, write the report."""
        started = time.monotonic()
        config = self._dagger().config()
        from manip_il.data.atomic import exclusive

        with exclusive(self.output_dir):
            self._run(config, started)

    def _run(self, config: RunConfig, started: float) -> None:
        prepare_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            check_same_options(self.output_dir, self, FREE)
        save_options(self.output_dir, self)
        from manip_il.cli.stages import Stages
        from manip_il.engine.engine import Engine

        kept = f"every finished episode, round and evaluation, in {self.output_dir}"
        with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
            engine.warm_up(learned=True)
            story = _Story(self, config, engine, stages)
            story.add_time("start", time.monotonic() - started)
            story.tell()

    def _dagger(self) -> DaggerOptions:
        """Of the rounds."""
        shared = ("robot", "task", "env", "demonstrations", "rounds", "episodes_per_round", "steps")
        shared += ("disturbed_share", "batch_size", "validation_episodes", "seed")
        same = {name: getattr(self, name) for name in shared}
        return DaggerOptions(**same, policy=self.policy.settings(), workers=self.workers)


class _Story:
    """One run of the quickstart, chapter by chapter."""

    def __init__(self, options: QuickstartOptions, config: RunConfig, engine: Engine, stages: Stages) -> None:
        self.options, self.config, self.engine, self.stages = options, config, engine, stages
        self.folder = options.output_dir
        path = self.folder / TIMINGS_FILE
        self.timings = _read_timings(path) if path.is_file() else {}

    def tell(self) -> None:
        """Every chapter, then table and report."""
        from manip_il.cli.story import picture, telling_seed
        from manip_il.evaluation.tables import print_table

        with self._timed("demonstrations and DAgger"):
            results = run_rounds(self.config, self.folder / "dagger", self.engine, self.stages)
        with self._timed("cloning with as many labels"):
            contestants = self._contestants(results)
        with self._timed("evaluations"):
            measured = self._measure(contestants)
        with self._timed("films"):
            _, cloned, _, dagger = contestants
            seed = telling_seed(measured["nominal"][cloned.key], measured["nominal"][dagger.key])
            pictures = picture(contestants, self.config.env, seed, self.stages)
        if pictures.note:
            warn([f"the report shows paths in place of films: {pictures.note}"])
        report = self._report(results, contestants, measured, pictures)
        report.write(self.folder / REPORT_FILE)
        print_table(report.table, empty="-")
        for sentence in (report.verdict, *report.facts):
            say(sentence)
        self._close(dagger)

    def _contestants(self, results: list[RoundResult]) -> tuple[Contestant, ...]:
        from manip_il.algorithms.rounds import best_round
        from manip_il.algorithms.run import round_folder
        from manip_il.cli.story import Contestant, clone_with_labels

        first, best = results[0], best_round(results)
        round_0 = round_folder(self.folder / "dagger", 0)
        policy, labels = clone_with_labels(
            self.config, results[-1].labels, round_0, self.folder / "cloning", self.engine, self.stages
        )
        return (
            Contestant("expert", "expert", "expert"),
            Contestant("cloned", "cloning", "cloning", first.policy, first.labels),
            Contestant("cloned_more", "cloning, as many labels", "cloning", policy, labels),
            Contestant("dagger", f"DAgger (round {best.round})", "dagger", best.policy, best.labels),
        )

    def _measure(self, contestants: tuple[Contestant, ...]) -> Measured:
        from manip_il.cli.story import measure
        from manip_il.seeding import stream_seeds

        counts = {"nominal": self.options.test_episodes, "disturbed": self.options.disturbed_episodes}
        measured = {
            name: measure(
                contestants,
                self.config.env,
                stream_seeds("test", count, self.options.seed),
                self.folder / "evaluation" / name,
                self.engine,
                self.stages,
            )
            for name, count in counts.items()
        }
        seeds = stream_seeds("validation", self.config.validation_episodes, self.options.seed)
        folder = self.folder / "evaluation" / "validation"
        more = [who for who in contestants if who.key == "cloned_more"]
        return measured | {"validation": measure(more, self.config.env, seeds, folder, self.engine, self.stages)}

    def _report(
        self,
        results: list[RoundResult],
        contestants: tuple[Contestant, ...],
        measured: Measured,
        pictures: Pictures,
    ) -> RunReport:
        from manip_il.cli.story import compare
        from manip_il.evaluation.report import RunReport
        from manip_il.evaluation.report_data import CurvePoint, PolicyRow
        from manip_il.evaluation.results import compare_results

        _, cloned, more, dagger = contestants
        nominal, disturbed = measured["nominal"], measured["disturbed"]
        rows = [PolicyRow.of(w.name, nominal[w.key], w.labels, disturbed[w.key], w.kind) for w in contestants]
        pairs = [(cloned, dagger), (more, dagger)]
        curve = learning_curve(self.folder / "dagger")
        points = CurvePoint(more.labels or 0, measured["validation"][more.key].success, "demonstrations alone")
        return RunReport(
            title=f"Quickstart: {self.config.env.robot} {self.config.env.task}",
            verdict=told_verdict(rows, compare_results(nominal[more.key], nominal[dagger.key]).significant),
            command=command_line("quickstart", self.options),
            rows=tuple(rows),
            facts=(
                *compare(nominal, pairs, "Undisturbed"),
                *compare(disturbed, pairs, "Disturbed"),
                f"{self.config.disturbed_share:.0%} of DAgger's rollouts were disturbed, no demonstration was.",
            ),
            curve=replace(curve, cloning=(points,)),
            films=pictures.films,
            strips=pictures.strips,
            paths=pictures.paths,
            pictures_note=pictures.note,
            disturbance=disturbed[dagger.key].settings.disturbance,
            config=to_plain(self.options),
            fingerprint=nominal[dagger.key].fingerprint,
            timings=self.timings | round_timings(self.folder / "dagger"),
        )

    @contextmanager
    def _timed(self, chapter: str) -> Generator[None]:
        """Add what a chapter takes, also where it is stopped, to what it took before."""
        started = time.monotonic()
        try:
            yield
        finally:
            self.add_time(chapter, time.monotonic() - started)

    def add_time(self, chapter: str, seconds: float) -> None:
        """Add what a chapter took [s]."""
        self.timings[chapter] = round(self.timings.get(chapter, 0.0) + seconds, 2)
        atomic_write(self.folder / TIMINGS_FILE, json.dumps(self.timings, indent=1) + "\n")

    def _close(self, dagger: Contestant) -> None:
        from manip_il.evaluation.report_data import format_seconds

        say(f"took {format_seconds(sum(self.timings.values()))} in all")
        say(f"report: {self.folder / REPORT_FILE}")
        say(f"next: manip-il eval --policy.path={dagger.policy} --eval.films=3 --output_dir={self.folder}_eval")


def _read_timings(path: Path) -> dict[str, float]:
    """Chapter -> what it took [s]."""
    timings = checks.read_json(path, f"the {TIMINGS_FILE} of a quickstart")
    return {name: checks.number(f"{path}: {name}", seconds, 0) for name, seconds in timings.items()}


def told_verdict(rows: Sequence[PolicyRow], shown: bool) -> str:
    """Return the first sentence of the report.

    shown: whether DAgger and cloning with as many labels are shown to differ.
    """
    from manip_il.evaluation.intervals import format_percent

    _, cloned, more, dagger = rows
    return (
        f"DAgger solves {format_percent(dagger.success.rate)} of {dagger.success.n:,} unseen starts, "
        f"cloning {format_percent(more.success.rate)} with as many labels "
        f"and {format_percent(cloned.success.rate)} with the first demonstrations alone."
        + ("" if shown else " So few starts show no difference between DAgger and cloning with as many labels.")
    )
