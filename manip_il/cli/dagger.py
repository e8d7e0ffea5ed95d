"""`manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il import checks
from manip_il.algorithms.config import ALGORITHMS, Method, RunConfig, Sampling, check_labels
from manip_il.algorithms.rounds import RoundResult, best_round
from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_given, require_dataset, round_policy
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import CONFIG_FILE, REPORT_FILE, ResumableOutput
from manip_il.cli.parsing import from_yaml
from manip_il.cli.progress import Stages, say, say_policy
from manip_il.data.json_lines import append_line, read_lines
from manip_il.errors import ManipError
from manip_il.learn.fit_config import FitConfig, check_weights
from manip_il.option import option
from manip_il.sim.config import CAMERAS

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.figures import Curve
    from manip_il.evaluation.report import Report
    from manip_il.sim.config import CameraConfig

METRICS_FILE, FINGERPRINT_FILE = "metrics.jsonl", "fingerprint.json"
_OF_FIT = ("policy", "action_space", "observation", "steps", "batch_size", "lr", "optimizer", "scheduler")


@dataclass
class GivenGroup:
    """`--dataset.*` of what a run begins with."""

    root: list[Path] = option(
        list, "recorded demonstrations to begin with, in place of recording round 0's", check=require_dataset
    )


@dataclass
class DaggerOptions:
    """Roll out the policy, ask the expert in every visited state, aggregate, refit, and repeat.

    Round 0 is behaviour cloning on the expert's own demonstrations, or on those in --dataset.root. With --policy.path
    it is that policy, and there are no demonstrations but those in --dataset.root. --policy.type is mlp, cnn or any
    policy of LeRobot's; its options are those of `manip-il train`. OUTPUT_DIR/best holds the round with the highest
    validation success.
    """

    example: ClassVar[str] = "manip-il dagger --rounds=5 --episodes_per_round=50 --output_dir=runs/dagger"
    first: ClassVar[tuple[str, ...]] = (
        "robot.type",
        "task.type",
        "demonstrations",
        "rounds",
        "episodes_per_round",
        "policy",
        "output_dir",
        "resume",
    )
    env: Given = common.env_given()
    method: Method = option(
        "dagger", f"who drives after round 0: {', '.join(one.driver for one in ALGORITHMS.values())}"
    )
    dataset: GivenGroup = field(default_factory=GivenGroup)
    settings: Given = given(RunConfig, prefix="")
    query: str | None = option(
        None,
        "when it is queried: every, one, probability:P, ensemble:BOUND, likelihood:NATS or safety:BOUND; "
        "by default every, for takeover one, for branch probability:1/STEPS",
    )
    sampling: Sampling = field(default_factory=Sampling)
    fit: Given = given(FitConfig, prefix="", only=_OF_FIT)
    cameras: list[str] = option(list, f"{common.CAMERAS_HELP}, for a policy on images; by default all for cnn")
    image: Given = common.image_given(small=True)
    vary: list[str] = common.vary_option()
    engine: common.EngineOptions = group(common.EngineOptions(), prefix="")
    trust: bool = common.trust_option()
    output: ResumableOutput = group(ResumableOutput(Path("runs/dagger")), prefix="")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        self.output.check()
        if self.dataset.root:
            check_weights(self.dataset.root, ())
        self._config()

    def run(self) -> None:
        """Run, or go on with, all rounds."""
        config = self.config()
        with self.output.open(self) as folder:
            kept = f"every finished episode and round, in {folder}"
            with Stages(kept) as stages, self.engine.open() as engine:
                engine.warm_up(learned=True)
                results = run_rounds(config, folder, engine, stages)
            _report(self, config, results).write(folder / REPORT_FILE)
        best = folder / "best" / "pretrained_model"
        if (folder / "dataset").is_dir():
            say(f"all rounds' labels as one dataset: {folder / 'dataset'}")
        say(f"report: {folder / REPORT_FILE}")
        robot = common.own_robot(config.env.robot)
        test = f"manip-il eval --policy.path={best}{robot} --output_dir={folder}/test"
        remedies = f"more --steps ({config.fit.total_steps:,} a round now)"
        if config.start is None and not config.datasets:
            remedies += f", more --demonstrations ({config.demonstrations:,} now)"
        say_policy(best, best_round(results).validation, test, remedies)

    def config(self) -> RunConfig:
        """Return what `run_algorithm` takes; `UsageError` for what does not go together."""
        config = self._config()
        check_labels(config)
        check_given(config)
        return config

    def _config(self) -> RunConfig:
        """Return the same before the policy's own configuration is checked, which takes seconds to import."""
        from manip_il.collect.query import parse_query  # which imports numpy
        from manip_il.evaluation.suites import varied

        policy, start = round_policy(self.fit.get("policy", {}))
        observation, cameras = self._pictures(start)
        env = common.env_config(self.env)
        of_fit: Given = {"policy": policy, "observation": observation, "trust": self.trust}
        return RunConfig(
            env=env,
            method=self.method,
            conditions=varied(self.vary, env, sees=cameras is not None),
            fit=FitConfig(**self.fit | of_fit),
            sampling=self.sampling,
            cameras=cameras,
            datasets=tuple(self.dataset.root),
            start=start,
            query_rule=None if self.query is None else parse_query(self.query),
            **self.settings,
        )

    def _pictures(self, start: Path | None) -> tuple[str | None, CameraConfig | None]:
        """Return observation and cameras: those given, else those of the policy to begin with."""
        observation = self.fit.get("observation")
        sees = self.fit.get("policy", {}).get("type") == "cnn" and observation != "state"
        cameras = common.camera_config(self.cameras or CAMERAS if sees else self.cameras, self.image, small=True)
        if start is None:
            return observation, cameras
        from manip_il.learn.checkpoint import Checkpoint
        from manip_il.learn.policy_files import policy_cameras

        return observation or Checkpoint.open(start).observation, cameras or policy_cameras(start)


def run_rounds(config: RunConfig, folder: Path, engine: Engine, stages: Stages) -> list[RoundResult]:
    """Run all rounds in `folder` with progress, a printed line and a line of `metrics.jsonl` a round."""
    from manip_il.algorithms.imitation import run_algorithm
    from manip_il.collect.environments import env_fingerprint
    from manip_il.evaluation.results import write_json

    fingerprint = env_fingerprint(config.env, config.cameras)
    write_json(folder / FINGERPRINT_FILE, fingerprint)
    results: list[RoundResult] = []
    for result in run_algorithm(config, folder, engine, stages.watch()):
        stages.close()
        # Unless it is there from before an interruption, with the seconds of then.
        if all(record.get("round") != result.round for record in read_lines(folder / METRICS_FILE)):
            append_line(folder / METRICS_FILE, result.to_json())
        results.append(result)
        took = f"{sum(result.seconds.values()):.0f} s"
        success = f"validation success {result.validation.success}"
        say(f"round {result.round}: {result.labels:,} labels, {success}, {took}")
        stages.check()
    return results


def _report(options: DaggerOptions, config: RunConfig, results: list[RoundResult]) -> Report:
    from manip_il.evaluation.eval_report import run_report
    from manip_il.evaluation.results import compare_results
    from manip_il.evaluation.tables import CLONING, DAGGER, PolicyRow

    best = best_round(results)
    kind = ALGORITHMS[config.method].title
    first = "cloning" if config.start is None else "the policy given"
    names = [f"{first} (round 0)", *(f"{kind}, round {result.round}" for result in results[1:])]
    rows = [
        PolicyRow(name, result.validation, result.labels, colour=DAGGER if result.round else CLONING)
        for name, result in zip(names, results, strict=True)
    ]
    facts = []
    if best.round > 0:
        comparison = compare_results(results[0].validation, best.validation, (names[0], names[best.round]))
        facts.append(f"{comparison.verdict} The best round was chosen on these episodes, so this flatters it.")
    return run_report(
        rows,
        curves=[learning_curve(options.output.output_dir, kind)],
        title=f"{kind} on {config.env.robot} {config.env.task}",
        verdict=best_verdict(names, results),
        command=command_line("dagger", options),
        facts=tuple(facts),
        config=to_plain(options),
        fingerprint=best.validation.fingerprint,
        timings=round_timings(options.output.output_dir),
    )


def best_verdict(names: Sequence[str], results: Sequence[RoundResult]) -> str:
    """Return which round is the best, its validation success, and whether it is shown to be better than round 0.

    Where round 0 is the best itself, it is compared with the last round. names: of the rounds.
    """
    from manip_il.evaluation.results import compare_results

    best = best_round(list(results))
    if not best.validation.success.successes:
        return f"No round of {len(results)} succeeds in any of {best.validation.success.n:,} validation episodes."
    found = f"{best.validation.success} success on {best.validation.success.n:,} validation episodes"
    other = results[0] if best.round else results[-1]
    if other is best:
        return f"{names[best.round]}: {found}."
    comparison = compare_results(other.validation, best.validation)
    name = names[best.round]
    if comparison.significant and comparison.difference > 0:
        return f"{name} is the best of {len(results)}: {found}."
    return f"{name} is chosen of {len(results)}, with {found}; no difference from {names[other.round]} is shown."


def learning_curve(folder: Path, name: str = "DAgger") -> Curve:
    """Return validation success over costs, one point a round. name: of the algorithm."""
    from manip_il.evaluation.figures import Curve
    from manip_il.evaluation.rounds import history

    return Curve(name, (history(read_lines(folder / METRICS_FILE), str(folder)),))


def run_curve(policy: Path | None) -> Curve | None:
    """Return the learning curve of the DAgger run that a policy lies in; None if it lies in none."""
    for folder in [] if policy is None else [policy, *policy.resolve().parents[:5]]:
        if (folder / METRICS_FILE).is_file():
            try:
                return learning_curve(folder, ALGORITHMS[from_yaml(folder / CONFIG_FILE, DaggerOptions).method].title)
            except (ManipError, KeyError):  # of another command, which counts no labels
                return None
    return None


def round_timings(folder: Path) -> dict[str, float]:
    """Return what each round's stages took [s], from the run's metrics."""
    path = folder / METRICS_FILE
    return {
        f"round {record.get('round')}, {stage}": checks.number(f"{path}: {stage}", seconds, 0)
        for record in read_lines(path)
        for stage, seconds in checks.mapping(f"{path}: seconds", record.get("seconds")).items()
    }
