"""Options of a run of reinforcement learning, its progress and its page: for `manip-il gail`, `airl` and `ppo`."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.cli import common_options as common
from manip_il.cli.inputs import find_policy
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, append_jsonl, open_output, read_jsonl, require_output
from manip_il.cli.progress import Stages, say, say_policy
from manip_il.learn.adversarial_config import PPOConfig
from manip_il.option import option, option_of

if TYPE_CHECKING:
    from manip_il.algorithms.learning_run import Iteration, LearningRun
    from manip_il.algorithms.run import Watch
    from manip_il.collect.workers import Engine
    from manip_il.sim.config import EnvConfig

METRICS_FILE = "metrics.jsonl"
FREE = ("workers", "output_dir")  # options that may differ when a run is resumed


@dataclass
class LearningOptions:
    """Options of every one of these commands, and what they do in the same way."""

    title: ClassVar[str]
    name: ClassVar[str]
    init: Path | None = option(None, "a cloned mlp, or its run, to begin with; by default a new policy")
    steps: int = option_of(LearningConfig, "steps")
    episodes: int = option_of(LearningConfig, "episodes")
    episode_steps: int = option_of(LearningConfig, "episode_steps")
    action_space: Literal["ee_delta", "joint_delta", "joint_target"] | None = option_of(LearningConfig, "action_space")
    log_std: float | None = option_of(LearningConfig, "log_std")
    warmup: int | None = option_of(LearningConfig, "warmup")
    ppo: PPOConfig = field(default_factory=PPOConfig)
    validation_every: int = option_of(LearningConfig, "validation_every")
    validation_episodes: int = option_of(LearningConfig, "validation_episodes")
    seed: int = common.seed_option()
    workers: int | None = option(1, "processes that validate")
    output_dir: Path = option(Path("runs/adversarial"), "folder of the run")
    resume: bool = option(False, "continue an interrupted run")
    overwrite: bool = option(False, "replace an existing run")

    @property
    def roots(self) -> tuple[Path, ...]:
        """Datasets of demonstrations."""
        return ()

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        common.require_workers(self.workers)
        require_output(self.output_dir, resume=self.resume, overwrite=self.overwrite)
        if self.init is not None:
            find_policy(self.init.expanduser())

    def run(self) -> None:
        """Run, or go on with, all iterations, and write the report."""
        from manip_il.algorithms.learning_run import best_validation, validations
        from manip_il.collect.workers import Engine

        config = self.learning_config()
        with open_output(self, FREE) as folder:
            kept = f"every finished iteration, in {folder}"
            with Stages(kept) as stages, Engine(self.workers) as engine:
                self._learn(config, folder, engine, stages)
            self._report(config, folder)
        say(f"report: {folder / REPORT_FILE}")
        robot = common.own_robot(config.env.robot)
        test = f"manip-il eval --policy.path={folder}{robot} --output_dir={folder}/test"
        remedies = f"more --steps ({config.steps:,} now){'' if self.init else ', a clone to begin with (--init)'}"
        found = validations(folder)
        say_policy(folder / "best" / "pretrained_model", found[best_validation(found)], test, remedies)

    def learning_config(self) -> LearningConfig:
        """Return what the run takes; raises for what is wrong with datasets and policy together."""
        env = self.environment()
        start = None if self.init is None else find_policy(self.init.expanduser())
        made: dict[str, Any] = {"env": env, "datasets": self.roots, "start": start}
        own = {one.name: getattr(self, one.name) for one in fields(LearningConfig) if hasattr(self, one.name)}
        return LearningConfig(**{**own, **made})

    def environment(self) -> EnvConfig:
        """Return where it learns; raises where that is not one and the same for all that is given."""
        raise NotImplementedError

    def iterations(self, config: LearningConfig, folder: Path, engine: Engine, watch: Watch) -> Iterator[Iteration]:
        """Return the run's iterations, the last finished one of a resumed run first."""
        raise NotImplementedError

    def _learn(self, config: LearningConfig, folder: Path, engine: Engine, stages: Stages) -> None:
        from manip_il.algorithms.run import Watch

        watch = Watch(on_episode=lambda _: stages.check(), on_step=stages.check)
        iterations = self.iterations(config, folder, engine, watch)
        stages.start(f"{self.name}, steps", config.steps)
        written = {record["iteration"] for record in read_jsonl(folder / METRICS_FILE)}
        for result in iterations:
            if result.number not in written:
                append_jsonl(folder / METRICS_FILE, result.to_json())
            shown = {name: result.metrics[name] for name in ("success", "kl") if name in result.metrics}
            stages.reach(result.steps, **shown)
            if result.validation is not None:
                say(f"{result.steps:,} steps: validation success {result.validation.success}")

    def _report(self, config: LearningConfig, folder: Path) -> None:
        from manip_il.algorithms.adversarial_report import adversarial_report
        from manip_il.algorithms.learning_run import validations

        title = f"{self.title} on {config.env.robot} {config.env.task}"
        records, command = read_jsonl(folder / METRICS_FILE), command_line(self.name, self)
        report = adversarial_report(title, validations(folder), records, command, to_plain(self))
        report.write(folder / REPORT_FILE)


def resumed(run: LearningRun, iterations: Iterator[Iteration]) -> Iterator[Iteration]:
    """Return a run's iterations after that which it goes on from, which may have ended before its line was written."""
    first = run.begin()
    return itertools.chain([first] if first else [], iterations)
