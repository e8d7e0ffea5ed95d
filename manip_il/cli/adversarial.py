"""`manip-il gail` and `manip-il airl`: a policy by reinforcement learning from demonstrations alone."""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterator
from dataclasses import MISSING, dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.cli import common_options as common
from manip_il.cli.inputs import check_dataset, find_policy, require_dataset
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import REPORT_FILE, append_jsonl, open_output, read_jsonl, require_output
from manip_il.cli.progress import Stages, say
from manip_il.errors import UsageError
from manip_il.learn.adversarial_config import DiscriminatorConfig, PPOConfig
from manip_il.learn.fit_config import check_weights
from manip_il.option import option, option_of

if TYPE_CHECKING:
    from manip_il.algorithms.learning_run import Iteration, LearningRun
    from manip_il.sim.config import EnvConfig

METRICS_FILE = "metrics.jsonl"
FREE = ("workers", "output_dir")  # options that may differ when a run is resumed


@dataclass
class DatasetGroup:
    """`--dataset.*`."""

    root: list[Path] = option(MISSING, "demonstrations; several are joined")


@dataclass
class AdversarialOptions:
    """Options of both commands."""

    title: ClassVar[str]
    name: ClassVar[str]
    dataset: DatasetGroup = field(default_factory=lambda: DatasetGroup([]))
    init: Path | None = option(None, "a cloned mlp, or its run, to begin with; by default a new policy")
    steps: int = option_of(LearningConfig, "steps")
    episodes: int = option_of(LearningConfig, "episodes")
    episode_steps: int = option_of(LearningConfig, "episode_steps")
    action_space: Literal["ee_delta", "joint_delta", "joint_target"] | None = option_of(LearningConfig, "action_space")
    log_std: float | None = option_of(LearningConfig, "log_std")
    warmup: int | None = option_of(LearningConfig, "warmup")
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    validation_every: int = option_of(LearningConfig, "validation_every")
    validation_episodes: int = option_of(LearningConfig, "validation_episodes")
    seed: int = common.seed_option()
    workers: int | None = option(1, "processes that validate")
    output_dir: Path = option(Path("runs/adversarial"), "folder of the run")
    resume: bool = option(False, "continue an interrupted run")
    overwrite: bool = option(False, "replace an existing run")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        common.require_workers(self.workers)
        require_output(self.output_dir, self.name, resume=self.resume, overwrite=self.overwrite)
        check_weights(self.dataset.root, ())
        for root in self.dataset.root:
            require_dataset(root)
        if self.init is not None:
            find_policy(self.init.expanduser())

    def run(self) -> None:
        """Run, or go on with, all iterations, and write the report."""
        from manip_il.engine.engine import Engine

        config = self.config()
        with open_output(self, FREE) as folder:
            kept = f"every finished iteration, in {folder}"
            with Stages(kept) as stages, Engine(self.workers) as engine:
                self._learn(config, folder, engine, stages)
            self._report(config, folder)
        say(f"best policy: {folder / 'best' / 'pretrained_model'}")
        say(f"report: {folder / REPORT_FILE}")
        robot = common.own_robot(config.env.robot)
        say(f"next: manip-il eval --policy.path={folder}{robot} --output_dir={folder}/test")

    def config(self) -> LearningConfig:
        """Return what the run takes; raises for what is wrong with datasets and policy together."""
        env = self._environment()
        start = None if self.init is None else find_policy(self.init.expanduser())
        own: dict[str, Any] = {
            one.name: getattr(self, one.name) for one in fields(LearningConfig) if hasattr(self, one.name)
        }
        return LearningConfig(**own, env=env, datasets=tuple(self.dataset.root), start=start)

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return the loop."""
        raise NotImplementedError

    def _environment(self) -> EnvConfig:
        """The environment of the demonstrations, which must be known here and one and the same."""
        from manip_il.data.lerobot_read import read_fingerprint, read_spec
        from manip_il.engine.simulations import is_known
        from manip_il.learn.sources import check_same_sources
        from manip_il.sim.config import EnvConfig

        roots = self.dataset.root
        specs = [read_spec(root) for root in roots]
        check_same_sources(roots, specs, pictures=False, language=False)
        spec = specs[0]
        if not is_known(spec.robot, spec.task):
            raise UsageError(f"{roots[0]} is for {spec.robot} {spec.task}, which cannot be simulated here")
        for root, one in zip(roots, specs, strict=True):
            check_dataset(root, one, read_fingerprint(root))
        return EnvConfig(spec.robot, spec.task, spec.fps, object=spec.object)

    def _learn(self, config: LearningConfig, folder: Path, engine: Any, stages: Stages) -> None:
        from manip_il.algorithms.learning_run import LearningRun
        from manip_il.algorithms.run import Watch

        run = LearningRun(config, folder, engine, Watch(on_episode=lambda _: stages.check(), on_step=stages.check))
        stages.start(f"{self.name}, steps", config.steps)
        written = {record["iteration"] for record in read_jsonl(folder / METRICS_FILE)}
        last = run.last
        for result in itertools.chain([last] if last else [], self.algorithm()(run, config)):
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


@dataclass
class GailOptions(AdversarialOptions):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the demonstrations', and PPO learns to be taken for the
    expert. OUTPUT_DIR/best holds the policy with the highest validation success: an mlp like that of `manip-il train`.
    """

    title: ClassVar[str] = "GAIL"
    name: ClassVar[str] = "gail"
    example: ClassVar[str] = "manip-il gail --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/gail"
    reward: Literal["logit", "log_d", "minus_log_one_minus_d"] = option(
        "logit", "of a step: log D - log(1 - D), log D, or -log(1 - D)"
    )

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return GAIL's loop."""
        from manip_il.algorithms.gail import gail

        return gail


@dataclass
class AirlOptions(AdversarialOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il gail`, with a discriminator in the form of a reward: exp f / (exp f + pi).
    """

    title: ClassVar[str] = "AIRL"
    name: ClassVar[str] = "airl"
    example: ClassVar[str] = "manip-il airl --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/airl"

    def algorithm(self) -> Callable[[LearningRun, LearningConfig], Iterator[Iteration]]:
        """Return AIRL's loop."""
        from manip_il.algorithms.airl import airl

        return airl
