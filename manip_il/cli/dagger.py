"""`manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.algorithms.config import ALGORITHMS, Method, RunConfig, check_labels
from manip_il.cli.common_options import SMALL, DatasetRoots, EngineOptions, Trusting, Varied, env_config, env_options
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say, say_next
from manip_il.data.atomic import write_json
from manip_il.evaluation.suites import varied
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.option import option
from manip_il.sim.config import CameraConfig
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.algorithms.results import Result
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.side import Side

_OF_FIT = ("policy", "action_space", "observation", "steps", "batch_size", "lr", "optimizer", "scheduler")


@dataclass(frozen=True)
class DaggerOptions(Varied, Trusting):
    """Roll out the policy, query the expert in every visited state, aggregate, refit, and repeat.

    Round 0 is behaviour cloning on new demonstrations of the expert, or on those in --dataset.root. With --policy.path
    round 0 is that policy, and only the demonstrations in --dataset.root are used. --policy.type is mlp, cnn or any
    LeRobot policy, with the options of `manip-il train`. OUTPUT_DIR/best holds the round with the highest validation
    success.
    """

    example: ClassVar[str] = "manip-il dagger --rounds=5 --episodes_per_round=50 --output_dir=runs/dagger"
    first: ClassVar[str] = "robot.type task.type demonstrations rounds episodes_per_round policy output_dir resume"
    env: Given = given(EnvConfig)
    method: Method = option(
        "dagger",
        "who drives after round 0: the learner (dagger), the expert (cloning), or the expert with noise like the "
        "learner's errors (dart)",
    )
    dataset: DatasetRoots = group(DatasetRoots([]))
    settings: Given = given(RunConfig, prefix="")
    query: str | None = option(
        None,
        "steps in which the expert is queried: every, one (per episode), probability:P, ensemble:BOUND, safety:BOUND; "
        "by default every; for --label=takeover: one; for --label=branch: probability:1/BRANCH_STEPS",
    )
    fit: Given = given(FitConfig, prefix="", only=_OF_FIT, fixed=("steps",))
    image: Given = given(CameraConfig, **SMALL)
    engine: EngineOptions = group(EngineOptions(), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/dagger")), prefix="")

    def run(self) -> None:
        """Run all rounds, or continue them."""
        config = self.config()
        with self.output.open(self) as folder:
            kept = f"every finished episode and round, in {folder}"
            with Stages(kept) as stages, self.engine.open() as engine:
                engine.warm_up(learned=True)
                results = run_rounds(config, folder, engine, stages)
            self._report(config, results, folder)
        best = folder / "best" / "pretrained_model"
        if (folder / "dataset").is_dir():
            say(f"labels of all rounds as one dataset: {folder / 'dataset'}")
        say(f"report: {folder / REPORT_FILE}", f"best policy: {best}")
        say_next("eval", f"--policy.path={best}", *env_options(config.env), f"--output_dir={folder}/test")

    def config(self) -> RunConfig:
        """Return the configuration of the run; raises if options contradict each other, or do not fit the inputs."""
        from manip_il.cli.inputs import check_given, round_policy
        from manip_il.collect.query import parse_query

        policy, start = round_policy(self.fit.get("policy", {}))
        observation, env = self.fit.get("observation"), env_config(self.env)
        sees = policy.get("type") == "cnn" and observation != "state"
        cameras = self.camera_config(env) if self.cameras or sees else None
        if start is not None:
            checkpoint = Checkpoint.open(start)
            observation, cameras = observation or checkpoint.observation, cameras or checkpoint.cameras
        config = RunConfig(
            env=env,
            method=self.method,
            conditions=varied(self.vary, env, sees=cameras is not None),
            fit=FitConfig(**dict(self.fit, policy=policy, observation=observation, trust=self.trust)),
            cameras=cameras,
            datasets=tuple(self.dataset.root),
            start=start,
            query_rule=None if self.query is None else parse_query(self.query),
            **self.settings,
        )
        check_labels(config)
        check_given(config)
        return config

    def _report(self, config: RunConfig, results: list[Result], folder: Path) -> None:
        """Write the report of a run."""
        from manip_il.algorithms.results import best_result
        from manip_il.evaluation.comparison import Comparison
        from manip_il.evaluation.side import Side
        from manip_il.evaluation.tables import CLONING, DAGGER

        best, kind = best_result(results), ALGORITHMS[config.method]
        first = "cloning" if config.start is None else "the policy given"
        names = [f"{first} (round 0)", *(f"{kind}, round {result.number}" for result in results[1:])]
        sides = [
            Side.of(name, result.validation, labels=result.labels, colour=DAGGER if result.number else CLONING)
            for name, result in zip(names, results, strict=True)
        ]
        success, facts = best.validation.success, tuple[str, ...]()
        if best.number > 0:
            verdict = Comparison(sides[0], sides[best.number]).verdict
            facts = (f"{verdict} The best round was chosen on these episodes, so its success is biased up.",)
        chosen = f"{names[best.number]}, best of {len(results)}"
        write_page(
            folder,
            folder,
            sides,
            kind,
            title=f"{kind} on {config.env.robot} {config.env.task}",
            verdict=f"{chosen}: {success} success on {success.n:,} validation episodes.",
            facts=facts,
            command=command_line(),
            config=to_plain(self),
        )


def run_rounds(config: RunConfig, folder: Path, engine: Engine, stages: Stages) -> list[Result]:
    """Run all rounds in `folder`, with progress and a printed line per round."""
    from manip_il.algorithms.run import Run
    from manip_il.collect.environments import env_fingerprint

    write_json(folder / "fingerprint.json", env_fingerprint(config.env, config.cameras))
    results: list[Result] = []
    for result in Run(config, folder, engine, stages.watch()).results():
        stages.close()
        results.append(result)
        success, took = f"validation success {result.validation.success}", f"{sum(result.seconds.values()):.0f} s"
        say(f"round {result.number}: {result.labels:,} labels, {success}, {took}")
        stages.check()
    return results


def write_page(folder: Path, run: Path, sides: list[Side], kind: str, **parts: Any) -> None:
    """Write to `folder` the report on the policies of `run`: their table, and curves of success over cost.

    kind: the algorithm's name. parts: see `run_report`.
    """
    from manip_il.evaluation.eval_report import run_report
    from manip_il.evaluation.side import Side, read_member

    page = run_report(sides, [Side(kind, (read_member(run),))], fingerprint=sides[-1].results[0].fingerprint, **parts)
    page.write(folder / REPORT_FILE)
