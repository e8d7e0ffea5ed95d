"""A study of `manip-il compare`: the same runs for several arms and training seeds, tested and compared."""

from __future__ import annotations

import contextlib
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.common_options import EngineOptions
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.inputs import check_policies
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say
from manip_il.cli.study_file import (
    ArmOptions,
    ExpertTest,
    Plan,
    keep_file,
    read_plan,
    with_start_cost,
    with_start_policy,
)
from manip_il.errors import NoEffect
from manip_il.seeding import stream_seeds

if TYPE_CHECKING:
    from manip_il.evaluation.arm import Member
    from manip_il.evaluation.runner import Trial
    from manip_il.evaluation.study import Study as Tested
    from manip_il.tasks.config import EnvConfig


class Study:
    """One study: its runs, their tests, and what comes of them."""

    def __init__(self, file: Path, engine: EngineOptions, output: ResumableOutput, *, trust: bool) -> None:
        self._file, self._engine, self._output, self._trust = file, engine, output, trust
        self._root = output.output_dir

    def run(self, options: Any, training_seeds: int | None) -> None:
        """Run what is not there yet, test it, print and write the answer. Raises `UsageError` for its file.

        options: of the command, to be kept. training_seeds: in place of the file's.
        """
        from manip_il.evaluation.results import write_json
        from manip_il.evaluation.study import FILE_NAME
        from manip_il.evaluation.tables import print_table

        plan = read_plan(self._file, training_seeds, self._trust)
        experts = expert_trials(plan)
        with self._output.open(options) as folder:
            keep_file(folder, plan.file)
            self._learn(plan)
            study = self._test(plan, experts)
            write_json(folder / FILE_NAME, study.to_json())
            self._report(plan, study, options)
        for table in study.tables():
            print_table(table)
        say(study.verdict, *study.facts, f"result: {folder / FILE_NAME}", f"report: {folder / REPORT_FILE}")

    def _learn(self, plan: Plan) -> None:
        """Run one after the other, seed by seed, so that a study that is stopped early has all arms.

        Raises `UsageError` once a run has no round that the study's rule selects, and not when all have run.
        """
        from manip_il.evaluation.arm import run_finished

        runs = [(name, seed) for seed in range(plan.file.training_seeds) for name in plan.arms]
        for number, (name, seed) in enumerate(runs, start=1):
            folder = self._folder(name, seed)
            # the report is what a run writes last
            if not ((folder / REPORT_FILE).is_file() and run_finished(folder)):
                say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
                self._options(plan, name, seed).run()
            member = self._member(plan, name, seed)
            member.select(plan.rule, plan.rule.limit({member.name: member.history}))

    def _options(self, plan: Plan, name: str, seed: int) -> ArmOptions:
        own = with_start_policy(plan.arms[name], lambda arm: self._folder(arm, seed))
        output = ResumableOutput(self._folder(name, seed), resume=True)
        own = replace(own, settings=own.settings | {"seed": seed}, output=output)
        engine = self._engine
        if isinstance(own, DaggerOptions):
            return replace(own, engine=engine)
        return replace(own, workers=engine.workers)

    def _test(self, plan: Plan, experts: Mapping[str, Mapping[str, Trial]]) -> Tested:
        from manip_il.evaluation.arm import Arm
        from manip_il.evaluation.study import Study as Tested

        seeds = range(plan.file.training_seeds)
        runs = {name: [self._member(plan, name, seed) for seed in seeds] for name in plan.arms}
        limit = plan.rule.limit({member.name: member.history for arm in runs.values() for member in arm})
        chosen = {name: [member.select(plan.rule, limit) for member in arm] for name, arm in runs.items()}
        trials = {name: self._trial(plan, name, arm) for name, arm in chosen.items()}
        kept = f"every finished run and evaluation, in {self._root}"
        with Stages(kept) as stages, self._engine.open() as engine:
            last = (self._root, engine, stages)
            arms = [Arm(name, tuple(one.measure(trials[name], *last) for one in arm)) for name, arm in chosen.items()]
            solved = {
                name: {
                    test: trial.measure(None, f"expert, {name}, {test}", trial.file(self._root, None), engine, stages)
                    for test, trial in tests.items()
                }
                for name, tests in experts.items()
            }
        return Tested(tuple(arms), plan.baseline, plan.file.target, plan.rule, limit, solved, plan.within)

    def _trial(self, plan: Plan, name: str, members: Iterable[Member]) -> Trial:
        """The test of an arm's policies, which are checked before any episode runs."""
        from manip_il.evaluation.runner import Trial

        policies = {member.name: member.policy for member in members if member.policy is not None}
        seeds = stream_seeds("test", plan.file.eval.n_episodes, 0)
        trial = Trial.of(plan.envs[name], seeds, plan.file.suite, policies.values(), self._trust)
        check_policies(policies, trial)
        return trial

    def _member(self, plan: Plan, name: str, seed: int) -> Member:
        from manip_il.evaluation.arm import run_member

        start, run = self._folder(plan.starts[name] or name, seed), run_member(self._folder(name, seed), seed)
        return replace(run, history=with_start_cost(plan.arms[name], run.history, start))

    def _folder(self, name: str, seed: int) -> Path:
        return self._root / name / f"seed_{seed}"

    def _report(self, plan: Plan, study: Tested, options: Any) -> None:
        from manip_il.evaluation.compare_report import study_report

        result = study.arms[0].members[0].test
        what = f"{result.robot} {result.task}" if plan.baseline else result.robot
        command = command_line("compare", options)
        page = study_report(study, f"Study: {what}, {self._file.stem}", command, to_plain(plan.file))
        page.write(self._root / REPORT_FILE)


def expert_trials(plan: Plan) -> dict[str, dict[str, Trial]]:
    """Return the expert's tests in every arm's task, arm -> name of the test -> trial.

    Without those that change nothing there, such as another object if there is none. Raises `ManipError` for names.
    """
    found: dict[str, dict[str, Trial]] = {name: {} for name in plan.envs}
    for name, env in plan.envs.items():
        for test, one in plan.experts.items():
            with contextlib.suppress(NoEffect):
                found[name][test] = _expert_trial(replace(env, robot=one.robot or env.robot), one)
    return found


def _expert_trial(env: EnvConfig, test: ExpertTest) -> Trial:
    from manip_il.evaluation.runner import Trial
    from manip_il.evaluation.suites import varied
    from manip_il.robots.table import get_robot  # here, as help needs no simulator

    get_robot(env.robot)
    seeds = stream_seeds("test", test.n_episodes, 0)
    if test.vary:
        return Trial(env, seeds, "+".join(test.vary), varied(test.vary, env, sees=False))
    return Trial.of(env, seeds, test.suite)
