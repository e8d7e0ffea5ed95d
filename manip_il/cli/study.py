"""`manip-il study`: the same runs for several arms and training seeds, tested and compared."""

from __future__ import annotations

import shlex
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il.cli.dagger import REPORT_FILE
from manip_il.cli.folders import atomic_write, prepare_output
from manip_il.cli.groups import ENGINE_HELP, WORKERS_HELP, check_same_options, option, save_options, trust_option
from manip_il.cli.measure import Trial, check_policies, measured, rule_json
from manip_il.cli.options import to_plain
from manip_il.cli.paths import require_output, require_workers
from manip_il.cli.progress import say
from manip_il.cli.shared_start import share_start
from manip_il.cli.sides import Source, limit_of, run_finished, run_history
from manip_il.cli.study_file import Plan, check_same_file, keep_file, read_plan
from manip_il.errors import UsageError
from manip_il.evaluation.comparison import Arm
from manip_il.evaluation.results import write_json
from manip_il.evaluation.study import FILE_NAME, TABLE_FILE, Study, table_markdown

if TYPE_CHECKING:
    from manip_il.cli.dagger import DaggerOptions
    from manip_il.evaluation.study_report import StudyReport

# What the file says is compared by itself.
FREE = ("workers", "engine", "output_dir", "file", "training_seeds", "trust")


@dataclass
class StudyOptions:
    """Run every arm of FILE with several training seeds, test all on the same unseen seeds, and compare.

    FILE holds `common` and `arms` (options of manip-il dagger), training_seeds, eval, checkpoint, at, baseline and
    target. OUTPUT_DIR/ARM/seed_0, seed_1, ... are the runs; study.json, table.md and report.html the results.
    """

    example: ClassVar[str] = "manip-il study configs/studies/chunk_labels.yaml --output_dir=runs/labels"
    file: Path = field(metadata={"help": "YAML of the study", "positional": True})
    training_seeds: int | None = option(None, "in place of the file's; a resumed study may have more")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    trust: bool = trust_option()
    output_dir: Path = field(default=Path("runs/study"), metadata={"help": "folder of the study"})
    resume: bool = option(False, "continue an interrupted study")
    overwrite: bool = option(False, "replace an existing study")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if not self.file.is_file():
            raise UsageError(
                f"{self.file} does not exist; expected the YAML of a study, such as configs/studies/*.yaml"
            )
        require_workers(self.workers)
        require_output(self.output_dir, "study", resume=self.resume, overwrite=self.overwrite)

    def run(self) -> None:
        """Run what is not there yet, test it, print and write the answer."""
        plan = read_plan(self.file, self.training_seeds, self.trust)
        from manip_il.data.atomic import exclusive

        with exclusive(self.output_dir):
            self._run(plan)

    def _run(self, plan: Plan) -> None:
        prepare_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            check_same_options(self.output_dir, self, FREE)
            check_same_file(self.output_dir, plan.file)
        save_options(self.output_dir, self)
        keep_file(self.output_dir, plan.file)
        self._learn(plan)
        study = self._test(plan)
        write_json(self.output_dir / FILE_NAME, study.to_json() | {"rule": rule_json(study.rule, study.limit)})
        atomic_write(self.output_dir / TABLE_FILE, table_markdown(study))
        self._report(plan, study).write(self.output_dir / REPORT_FILE)
        self._say(study)

    def _learn(self, plan: Plan) -> None:
        """One run after the other, seed by seed, so that a study that is stopped early has all arms."""
        runs = [(name, seed) for seed in range(plan.file.training_seeds) for name in plan.arms]
        for number, (name, seed) in enumerate(runs, start=1):
            folder = self._folder(name, seed)
            if (folder / REPORT_FILE).is_file() and run_finished(folder):  # the report is what a run writes last
                continue
            say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
            options = self._options(plan, name, seed)
            share_start(options, [self._options(plan, other, seed) for other in plan.arms if other != name])
            options.run()

    def _options(self, plan: Plan, name: str, seed: int) -> DaggerOptions:
        own = replace(plan.arms[name], seed=seed, output_dir=self._folder(name, seed), resume=True, overwrite=False)
        return replace(own, engine=self.engine, workers=self.workers)

    def _test(self, plan: Plan) -> Study:
        from manip_il.cli.stages import Stages
        from manip_il.engine.engine import Engine
        from manip_il.seeding import stream_seeds

        sources = {name: self._sources(plan, name) for name in plan.arms}
        everything = [source for arm in sources.values() for source in arm]
        limit = limit_of(plan.rule, everything)
        policies = {source.name: source.chosen(plan.rule, limit)[0] for source in everything}
        seeds = stream_seeds("test", plan.file.eval.n_episodes, 0)
        trial = Trial.of(plan.env, seeds, plan.file.suite, policies.values(), self.trust)
        check_policies(trial, policies, self.output_dir, self.engine)
        kept = f"every finished run and evaluation, in {self.output_dir}"
        with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
            arms = tuple(
                Arm(name, tuple(measured(s, plan.rule, limit, trial, self.output_dir, engine, stages) for s in arm))
                for name, arm in sources.items()
            )
        return Study(arms, plan.baseline, plan.file.target, plan.rule, limit)

    def _sources(self, plan: Plan, name: str) -> list[Source]:
        folders = {seed: self._folder(name, seed) for seed in range(plan.file.training_seeds)}
        return [Source(folder, seed, history=run_history(folder)) for seed, folder in folders.items()]

    def _folder(self, name: str, seed: int) -> Path:
        return self.output_dir / name / f"seed_{seed}"

    def _report(self, plan: Plan, study: Study) -> StudyReport:
        from manip_il.evaluation.study_report import study_report

        result = study.arms[0].members[0].result
        words = ["manip-il", "study", str(self.file), f"--output_dir={self.output_dir}"]
        if self.training_seeds is not None:
            words.append(f"--training_seeds={self.training_seeds}")
        if self.trust:
            words.append("--trust=true")
        title = f"Study: {result.robot} {result.task}, {self.file.stem}"
        return study_report(study, title, shlex.join(words), to_plain(plan.file))

    def _say(self, study: Study) -> None:
        from manip_il.evaluation.tables import print_table

        print_table(study.results_table())
        print_table(study.target_table())
        for sentence in (study.verdict, *study.facts):
            say(sentence)
        say(f"table: {self.output_dir / TABLE_FILE}")
        say(f"result: {self.output_dir / FILE_NAME}")
        say(f"report: {self.output_dir / REPORT_FILE}")
        say(f"next: {self._next(study)}")

    def _next(self, study: Study) -> str:
        best = max(study.arms, key=lambda arm: arm.test_rate)
        other = study.baseline if best.name != study.baseline else study.arms[-1].name
        if other == best.name:
            return f"manip-il eval --policy.path={best.members[0].policy} --eval.films=3"
        left, right = self.output_dir / other, self.output_dir / best.name
        return f"manip-il compare {left} {right} --at=seconds --output_dir={self.output_dir}_seconds"
