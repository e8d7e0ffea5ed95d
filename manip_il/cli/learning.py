"""`manip-il rl gail`, `airl`, `ppo`: reinforcement learning from demonstrations or a learnt reward."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.cli.common_options import DatasetRoots, EngineOptions, env_options
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say, say_next
from manip_il.data.json_lines import read_lines
from manip_il.evaluation.policy_folder import find_policy
from manip_il.learn.adversarial_config import DiscriminatorConfig, PPOConfig
from manip_il.option import option
from manip_il.tasks.config import stored_config

if TYPE_CHECKING:
    from manip_il.data.schema import RobotTaskSpec
    from manip_il.learn.checkpoint import Origin


@dataclass(frozen=True)
class Learning:
    """What `rl gail`, `rl airl` and `rl ppo` share: options, run, progress and report."""

    method: ClassVar[str]
    first: ClassVar[str] = "dataset.root init steps reward validation_episodes output_dir resume"
    init: Path | None = option(None, "a cloned mlp (a checkpoint or a run) to start from; by default a new policy")
    settings: Given = given(LearningConfig, prefix="")
    ppo: PPOConfig = field(default_factory=PPOConfig)
    engine: EngineOptions = group(EngineOptions(1), prefix="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/rl")), prefix="")

    def run(self) -> None:
        """Run all iterations, or continue them, and write the report."""
        from manip_il.algorithms.results import Watch, learning_report, validations
        from manip_il.algorithms.run import Run
        from manip_il.evaluation.rounds import METRICS_FILE

        config = self.learning_config()
        with self.output.open(self) as folder:
            kept = f"every finished iteration, in {folder}"
            with Stages(kept) as stages, self.engine.open() as engine:
                watch = Watch(on_episode=lambda _: stages.check(), on_step=stages.check)
                stages.start(f"{self.method.upper()}, steps", config.steps)
                for result in Run(config, folder, engine, watch).results():
                    stages.log({"step": result.steps} | result.metrics)
                    if result.validated is not None:
                        say(f"{result.steps:,} steps: validation success {result.validated.success}")
            title, found = f"{self.method.upper()} on {config.env.robot} {config.env.task}", validations(folder)
            records, command = read_lines(folder / METRICS_FILE), command_line()
            learning_report(title, found, records, command, to_plain(self)).write(folder / REPORT_FILE)
        best = folder / "best" / "pretrained_model"
        say(f"report: {folder / REPORT_FILE}", f"best policy: {best}")
        say_next("eval", f"--policy.path={best}", *env_options(config.env), f"--output_dir={folder}/test")

    def learning_config(self) -> LearningConfig:
        """Return the configuration of the run; raises if datasets, policy and environment do not fit."""
        raise NotImplementedError

    def _config(self, spec: RobotTaskSpec | Origin, **more: Any) -> LearningConfig:
        """Return the configuration for the environment of `spec`; `UnknownName` if that is not built in."""
        env = stored_config(spec)
        start = None if self.init is None else find_policy(self.init)
        return LearningConfig(method=self.method, env=env, ppo=self.ppo, start=start, **more, **self.settings)


@dataclass(frozen=True, kw_only=True)
class GailOptions(Learning):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the expert's, and PPO learns to fool it. OUTPUT_DIR/best
    holds the policy with the highest validation success: an mlp like that of `manip-il train`.
    """

    method: ClassVar[str] = "gail"
    example: ClassVar[str] = "manip-il rl gail --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/gail"
    dataset: DatasetRoots
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    output: ResumableOutput = group(ResumableOutput(Path("runs/gail")), prefix="")

    def learning_config(self) -> LearningConfig:
        """Return the configuration of the run; raises if the demonstrations are not of one known environment."""
        from manip_il.cli.inputs import open_datasets

        first, *_ = open_datasets(self.dataset.root, pictures=False)
        return self._config(first.spec, datasets=tuple(self.dataset.root), discriminator=self.discriminator)


@dataclass(frozen=True, kw_only=True)
class AirlOptions(GailOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il rl gail`, with the discriminator exp f / (exp f + pi): f is a learnt reward, pi the policy's density.
    """

    method: ClassVar[str] = "airl"
    example: ClassVar[str] = "manip-il rl airl --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/airl"
    output: ResumableOutput = group(ResumableOutput(Path("runs/airl")), prefix="")


@dataclass(frozen=True, kw_only=True)
class PpoOptions(Learning):
    """Improve a cloned policy (--init) by PPO with a reward learnt from preferences.

    Episodes continue after success, because the reward scores every state. OUTPUT_DIR/best holds the policy with the
    highest validation success, which may be the initial one.
    """

    method: ClassVar[str] = "ppo"
    example: ClassVar[str] = "manip-il rl ppo --init=runs/cloned --reward=runs/reward --output_dir=runs/ppo"
    init: Path = option(MISSING, "the cloned mlp (a checkpoint or a run) to improve", exists="")
    reward: Path = option(MISSING, "the reward: a folder from manip-il reward fit", exists="")
    output: ResumableOutput = group(ResumableOutput(Path("runs/ppo")), prefix="")

    def learning_config(self) -> LearningConfig:
        """Return the configuration of the run; raises `MismatchError` if the reward does not fit the environment."""
        from manip_il.collect.environments import env_spec
        from manip_il.learn.reward import LearnedReward

        reward = LearnedReward.load(found := find_policy(self.reward))
        config = self._config(reward.origin, reward=found)
        reward.check_fits("the environment", env_spec(config.env))
        return config
