"""`manip-il dagger`: roll out, label, aggregate, refit, and repeat."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il import checks
from manip_il.algorithms.table import ALGORITHMS, Method, run_algorithm
from manip_il.cli.folders import append_jsonl, atomic_write, prepare_output, read_jsonl
from manip_il.cli.groups import (
    ENGINE_HELP,
    WORKERS_HELP,
    EnvGroup,
    ImageGroup,
    RobotGroup,
    TaskGroup,
    check_same_options,
    command_line,
    option,
    policy_help,
    save_options,
    start_policy,
    trust_option,
)
from manip_il.cli.options import Open, to_plain
from manip_il.cli.paths import require_output, require_workers
from manip_il.cli.progress import say
from manip_il.learn.fit_config import BATCH_SIZE, MLP_BATCH_SIZE, MLP_LR, MLP_STEPS, FitConfig

if TYPE_CHECKING:
    from manip_il.algorithms.config import RunConfig
    from manip_il.algorithms.rounds import RoundResult
    from manip_il.cli.stages import Stages
    from manip_il.engine.engine import Engine
    from manip_il.evaluation.report import RunReport
    from manip_il.evaluation.report_data import LearningCurve

METRICS_FILE, FINGERPRINT_FILE, REPORT_FILE = "metrics.jsonl", "fingerprint.json", "report.html"
METHOD_HELP = f"who drives after round 0: {', '.join(one.who for one in ALGORITHMS.values())}"
FREE = ("workers", "engine", "output_dir", "trust")


@dataclass
class SamplingGroup:
    """`--sampling.*`: how often frames are learnt from, relative to each other."""

    demonstrations: float = option(1.0, "weight of a frame of round 0")
    corrections: float = option(1.0, "weight of a later frame where the expert drove or would have acted differently")
    rollouts: float = option(1.0, "weight of the other later frames")


@dataclass
class DaggerOptions:
    """Roll out the policy, ask the expert in every visited state, aggregate, refit, and repeat.

    Round 0 is behaviour cloning on the expert's own demonstrations. --policy.type is mlp, cnn or any policy of
    LeRobot's; its options are those of `manip-il train`. OUTPUT_DIR/best holds the round with the highest
    validation success.
    """

    example: ClassVar[str] = "manip-il dagger --rounds=5 --episodes_per_round=50 --output_dir=runs/dagger"
    robot: RobotGroup = field(default_factory=RobotGroup)
    task: TaskGroup = field(default_factory=TaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    method: Method = field(default="dagger", metadata={"help": METHOD_HELP})
    demonstrations: int = option(50, "successful expert episodes of round 0")
    rounds: int = option(5, "DAgger rounds after round 0; a resumed run may have more")
    episodes_per_round: int = option(50, "rollouts per round; with --method=cloning, successful ones")
    label_budget: int | None = option(None, "expert labels of all rounds together at which the run ends")
    disturbed_share: float = option(
        0.5, "share of a round's rollouts that are disturbed: object knocked, noisy actions"
    )
    beta: str = option("constant:0", "share of steps that the expert drives: constant:B, linear:ROUNDS, exponential:B")
    label: Literal["per_state", "takeover", "branch"] = option(
        "per_state",
        "what the expert gives when it is queried: one action, a drive to the end, or a branch (docs/dagger.md)",
    )
    query: str | None = option(
        None,
        "when it is queried: every, one, probability:P, ensemble:BOUND, likelihood:NATS or safety:BOUND; "
        "by default every, for takeover one, for branch probability:1/STEPS",
    )
    branch_steps: int | None = option(None, "control steps of a branch; by default as many as the policy plans")
    ensemble: int = option(1, "policies fitted a round, of which the first drives; for --query=ensemble:BOUND")
    sampling: SamplingGroup = field(default_factory=SamplingGroup)
    policy: Open = field(default_factory=dict, metadata={"help": "type (mlp), or path of a policy to start from; ..."})
    observation: Literal["state", "images", "both"] | None = option(
        None, "what the policy observes besides its joints; by default images if it is cnn, else state"
    )
    cameras: list[str] = field(default_factory=list, metadata={"help": "front, wrist or both, for a policy on images"})
    image: ImageGroup = field(default_factory=ImageGroup)
    refit: Literal["scratch", "warm"] = option("scratch", "how each round's policy starts")
    steps: int | None = option(None, f"gradient steps per round; by default {MLP_STEPS:,} for mlp, else 20,000")
    refit_steps: int | None = option(None, "gradient steps in later rounds, with --refit=warm; by default as many")
    batch_size: int | None = option(None, f"frames per step; by default {MLP_BATCH_SIZE} for mlp, else {BATCH_SIZE}")
    lr: float | None = option(None, f"peak learning rate; by default {MLP_LR} for mlp, else the policy's own")
    optimizer: Open = field(default_factory=dict, metadata={"help": "in place of the policy's own: type (adamw), ..."})
    scheduler: Open = field(default_factory=dict, metadata={"help": "in place of the policy's own: type, ..."})
    validation_episodes: int = option(200, "unseen episodes that choose the best round")
    hold: int = option(10, "control steps of a rollout after success")
    seed: int = option(0, "shifts every random stream, 0 to 1000")
    engine: Literal["local", "ray"] = option("local", ENGINE_HELP)
    workers: int | None = option(None, WORKERS_HELP)
    trust: bool = trust_option()
    output_dir: Path = field(default=Path("runs/dagger"), metadata={"help": "folder of the run"})
    resume: bool = option(False, "continue an interrupted run")
    overwrite: bool = option(False, "replace an existing run")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        require_workers(self.workers)
        require_output(self.output_dir, "dagger", resume=self.resume, overwrite=self.overwrite)
        self._draft()

    def run(self) -> None:
        """Run, or go on with, all rounds."""
        config = self.config()
        from manip_il.data.atomic import exclusive

        with exclusive(self.output_dir):
            self._run(config)

    def _run(self, config: RunConfig) -> None:
        prepare_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.resume:
            check_same_options(self.output_dir, self, FREE, may_grow="rounds")
        save_options(self.output_dir, self)
        from manip_il.cli.stages import Stages
        from manip_il.engine.engine import Engine

        kept = f"every finished episode and round, in {self.output_dir}"
        with Stages(kept) as stages, Engine(self.workers, self.engine) as engine:
            engine.warm_up(learned=True)
            results = run_rounds(config, self.output_dir, engine, stages)
        _report(self, config, results).write(self.output_dir / REPORT_FILE)
        best = self.output_dir / "best" / "pretrained_model"
        say(f"best policy: {best}")
        say(f"all rounds' labels as one dataset: {self.output_dir / 'dataset'}")
        say(f"report: {self.output_dir / REPORT_FILE}")
        say(f"next: manip-il eval --policy.path={best} --output_dir={self.output_dir}/test")

    def config(self) -> RunConfig:
        """What `run_algorithm` takes. Raises `UsageError` for what does not go together."""
        config = self._draft()
        from manip_il.algorithms.config import check_labels

        check_labels(config)
        return config

    def _draft(self) -> RunConfig:
        """The same, before the policy's own configuration has been made, which takes seconds to import."""
        env = self.env.config(self.robot.type, self.task.type)
        cameras = self.image.config(self.cameras)
        from manip_il.algorithms.beta import BetaSchedule
        from manip_il.algorithms.config import RunConfig, check_sight
        from manip_il.algorithms.sampling import Sampling
        from manip_il.engine.query import QueryRule

        made = {"env", "fit", "sampling", "cameras", "beta", "query_rule"}
        own = {one.name for one in fields(RunConfig)} - made
        config = RunConfig(
            env=env,
            fit=self._fit(),
            sampling=Sampling(**to_plain(self.sampling)),
            cameras=cameras,
            beta=BetaSchedule.parse(self.beta),
            query_rule=None if self.query is None else QueryRule.parse(self.query),
            **{name: getattr(self, name) for name in own},
        )
        check_sight(config)
        return config

    def _fit(self) -> FitConfig:
        own = ("observation", "steps", "batch_size", "lr", "optimizer", "scheduler", "trust")
        return FitConfig(policy=start_policy(self.policy), **{name: getattr(self, name) for name in own})

    @classmethod
    def more_help(cls, words: Sequence[str]) -> str:
        """Return the options of the policy that `--policy.type` names."""
        return policy_help(words)


def run_rounds(config: RunConfig, folder: Path, engine: Engine, stages: Stages) -> list[RoundResult]:
    """Run all rounds in `folder` with progress, a printed line and a line of `metrics.jsonl` a round."""
    from manip_il.engine.describe import env_fingerprint

    fingerprint = env_fingerprint(config.env, config.cameras)
    atomic_write(folder / FINGERPRINT_FILE, json.dumps(fingerprint, indent=1) + "\n")
    results: list[RoundResult] = []
    for result in run_algorithm(config, folder, engine, stages.watch()):
        stages.close()
        _add_metrics(folder / METRICS_FILE, result)
        results.append(result)
        say(_line(result))
        stages.check()
    return results


def _add_metrics(path: Path, result: RoundResult) -> None:
    """Add the round's line, unless an earlier run has: what it took then is what is true."""
    if all(record.get("round") != result.round for record in read_jsonl(path)):
        append_jsonl(path, result.to_json())


def _line(result: RoundResult) -> str:
    seconds = sum(result.seconds.values())
    return (
        f"round {result.round}: {result.labels:,} labels, validation success {result.validation.success}, "
        f"{seconds:.0f} s"
    )


def _report(options: DaggerOptions, config: RunConfig, results: list[RoundResult]) -> RunReport:
    from manip_il.algorithms.rounds import best_round
    from manip_il.evaluation.report import RunReport
    from manip_il.evaluation.report_data import PolicyRow
    from manip_il.evaluation.results import compare_results

    best = best_round(results)
    kind = ALGORITHMS[config.method].title
    names = ["cloning (round 0)", *(f"{kind}, round {result.round}" for result in results[1:])]
    rows = [
        PolicyRow.of(name, result.validation, result.labels, kind="dagger" if result.round else "cloning")
        for name, result in zip(names, results, strict=True)
    ]
    facts = []
    if best.round > 0:
        comparison = compare_results(results[0].validation, best.validation, (names[0], names[best.round]))
        facts.append(f"{comparison.verdict} The best round was chosen on these episodes, so this flatters it.")
    return RunReport(
        title=f"{kind} on {config.env.robot} {config.env.task}",
        verdict=best_verdict(names, results),
        command=command_line("dagger", options),
        rows=tuple(rows),
        facts=tuple(facts),
        curve=learning_curve(options.output_dir, kind),
        config=to_plain(options),
        fingerprint=best.validation.fingerprint,
        timings=round_timings(options.output_dir),
    )


def best_verdict(names: Sequence[str], results: Sequence[RoundResult]) -> str:
    """Which round was taken, with its validation success, and whether it is shown to be better than round 0.

    Where round 0 is the best itself, the last round takes its place. names: of the rounds.
    """
    from manip_il.algorithms.rounds import best_round
    from manip_il.evaluation.results import compare_results

    best = best_round(list(results))
    found = f"{best.validation.success} success on {best.validation.success.n:,} validation episodes"
    other = results[0] if best.round else results[-1]
    if other is best:
        return f"{names[best.round]}: {found}."
    comparison = compare_results(other.validation, best.validation)
    if comparison.significant and comparison.difference > 0:
        return f"{names[best.round]} is the best of {len(results)}: {found}."
    return (
        f"{names[best.round]} is chosen of {len(results)}, with {found}; "
        f"no difference from {names[other.round]} is shown."
    )


def learning_curve(folder: Path, name: str = "DAgger") -> LearningCurve:
    """Return validation success over labels, episodes and wall-clock, one point a round. name: what made the rounds."""
    from manip_il.evaluation.report_data import LearningCurve
    from manip_il.evaluation.rounds import curve_points, history

    return LearningCurve(dagger=curve_points(history(read_jsonl(folder / METRICS_FILE), str(folder))), name=name)


def round_timings(folder: Path) -> dict[str, float]:
    """What each round's stages took [s], as the run that made them measured it."""
    path = folder / METRICS_FILE
    return {
        f"round {record.get('round')}, {stage}": checks.number(f"{path}: {stage}", seconds, 0)
        for record in read_jsonl(path)
        for stage, seconds in checks.mapping(f"{path}: seconds", record.get("seconds")).items()
    }
