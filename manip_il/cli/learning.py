"""`manip-il rl gail`, `airl`, `ppo`: a policy by reinforcement learning, from demonstrations or a learnt reward."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.algorithms.learning_config import LearningConfig
from manip_il.cli import common_options as common
from manip_il.cli.inputs import REWARD, dataset_differences, exists, load_reward, require_dataset, reward_folder
from manip_il.cli.options import Given, command_line, given, group, to_plain
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.progress import Stages, say, say_policy, warn
from manip_il.data.json_lines import append_line, read_lines
from manip_il.errors import UsageError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.learn.adversarial_config import DiscriminatorConfig, PPOConfig
from manip_il.option import option
from manip_il.tasks.config import make_config

if TYPE_CHECKING:
    from manip_il.collect.workers import Engine
    from manip_il.data.schema import RobotTaskSpec
    from manip_il.learn.checkpoint import Origin
    from manip_il.tasks.config import EnvConfig

METRICS_FILE = "metrics.jsonl"
_INIT = "a cloned mlp, or its run, to begin with"
_OF_ALL = (
    *("steps", "episodes", "episode_steps", "action_space", "log_std", "warmup", "validation_every"),
    *("validation_episodes", "seed"),
)
_FIRST = "dataset.root init steps reward validation_episodes output_dir resume"


@dataclass
class GivenGroup:
    """`--dataset.*`."""

    root: list[Path] = option(MISSING, "demonstrations; several are joined", check=require_dataset)


class Learning:
    """Base of these commands: a run of a method, its progress and its page."""

    title: ClassVar[str]
    method: ClassVar[str]
    first: ClassVar[str] = _FIRST
    settings: Given
    ppo: PPOConfig
    workers: int | None
    output: ResumableOutput

    def run(self) -> None:
        """Run, or go on with, all iterations, and write the report."""
        from manip_il.algorithms.learning_run import best_validation, validations
        from manip_il.collect.workers import Engine

        config = self.learning_config()
        with self.output.open(self) as folder:
            kept = f"every finished iteration, in {folder}"
            with Stages(kept) as stages, Engine(self.workers) as engine:
                self._learn(config, folder, engine, stages)
            self._report(config, folder)
        say(f"report: {folder / REPORT_FILE}")
        robot = common.own_names(config.env.robot, config.env.task, config.env.object)
        test = f"manip-il eval --policy.path={folder}{robot} --output_dir={folder}/test"
        remedies = f"more --steps ({config.steps:,} now){'' if config.start else ', a clone to begin with (--init)'}"
        found = validations(folder)
        say_policy(folder / "best" / "pretrained_model", found[best_validation(found)], test, remedies)

    def learning_config(self) -> LearningConfig:
        """Return what the run takes; raises for what is wrong with datasets and policy together."""
        raise NotImplementedError

    def _learn(self, config: LearningConfig, folder: Path, engine: Engine, stages: Stages) -> None:
        from manip_il.algorithms.learning_run import LearningRun
        from manip_il.algorithms.run import Watch

        watch, metrics = Watch(on_episode=lambda _: stages.check(), on_step=stages.check), folder / METRICS_FILE
        results = LearningRun(config, folder, engine, watch).results()
        stages.start(f"{self.title}, steps", config.steps)
        written = {record["iteration"] for record in read_lines(metrics)}
        for result in results:
            if result.number not in written:
                append_line(metrics, result.to_json())
            shown = {name: result.metrics[name] for name in ("success", "kl") if name in result.metrics}
            stages.reach(result.steps, **shown)
            if result.validated is not None:
                say(f"{result.steps:,} steps: validation success {result.validated.success}")

    def _report(self, config: LearningConfig, folder: Path) -> None:
        from manip_il.algorithms.learning_run import learning_report, validations

        title = f"{self.title} on {config.env.robot} {config.env.task}"
        records, command = read_lines(folder / METRICS_FILE), command_line(f"rl {self.method}", self)
        report = learning_report(title, validations(folder), records, command, to_plain(self))
        report.write(folder / REPORT_FILE)


@dataclass
class GailOptions(Learning):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the demonstrations'; PPO is rewarded for being mistaken for
    the expert. OUTPUT_DIR/best holds the policy with the highest validation success: an mlp like that of `manip-il
    train`.
    """

    title: ClassVar[str] = "GAIL"
    method: ClassVar[str] = "gail"
    example: ClassVar[str] = "manip-il rl gail --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/gail"
    dataset: GivenGroup
    init: Path | None = option(None, f"{_INIT}; by default a new policy", check=find_policy)
    settings: Given = given(LearningConfig, prefix="", only=_OF_ALL)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    workers: int | None = option(1, "processes that validate", at_least=1, free=True)
    output: ResumableOutput = group(ResumableOutput(Path("runs/gail")), prefix="")

    def learning_config(self) -> LearningConfig:
        """Return what the run takes; raises if the demonstrations are not all for one environment that is known."""
        from manip_il.data.dataset import Dataset
        from manip_il.learn.sources import check_same_sources

        opened = [Dataset.open(root) for root in self.dataset.root]
        check_same_sources(self.dataset.root, [one.spec for one in opened], pictures=False, language=False)
        env = _known_env(str(opened[0].root), opened[0].spec)
        for one in opened:
            warn(*dataset_differences(str(one.root), one.spec, one.fingerprint))
        return LearningConfig(
            method=self.method,
            env=env,
            datasets=tuple(self.dataset.root),
            start=None if self.init is None else find_policy(self.init),
            ppo=self.ppo,
            discriminator=self.discriminator,
            **self.settings,
        )


@dataclass
class AirlOptions(GailOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il rl gail`, with a discriminator in the form of a reward: exp f / (exp f + pi).
    """

    title: ClassVar[str] = "AIRL"
    method: ClassVar[str] = "airl"
    example: ClassVar[str] = "manip-il rl airl --dataset.root=datasets/demos --init=runs/cloned --output_dir=runs/airl"
    settings: Given = given(LearningConfig, prefix="", only=_OF_ALL)
    output: ResumableOutput = group(ResumableOutput(Path("runs/airl")), prefix="")


@dataclass
class PpoOptions(Learning):
    """Improve a cloned policy by PPO on a reward that was learnt from preferences.

    Episodes go on after success, as the reward says how good every state is. OUTPUT_DIR/best holds the policy with the
    highest validation success, which may be the one that it began with.
    """

    title: ClassVar[str] = "PPO"
    method: ClassVar[str] = "ppo"
    example: ClassVar[str] = "manip-il rl ppo --init=runs/cloned --reward=runs/reward --output_dir=runs/ppo"
    init: Path = option(MISSING, _INIT, check=find_policy)
    reward: Path = option(MISSING, "the reward: a folder of manip-il reward fit", check=exists(REWARD))
    settings: Given = given(LearningConfig, prefix="", only=_OF_ALL)
    ppo: PPOConfig = field(default_factory=PPOConfig)
    workers: int | None = option(1, "processes that validate", at_least=1, free=True)
    output: ResumableOutput = group(ResumableOutput(Path("runs/ppo")), prefix="")

    def learning_config(self) -> LearningConfig:
        """Return what the run takes; raises `MismatchError` if reward and environment do not fit."""
        from manip_il.collect.environments import env_spec

        reward = load_reward(self.reward)
        origin = reward.origin
        env = _known_env(str(self.reward), origin)
        reward.check_fits("the environment", env_spec(env))
        paths = {"start": find_policy(self.init), "reward": reward_folder(self.reward)}
        return LearningConfig(method=self.method, env=env, ppo=self.ppo, **paths, **self.settings)


def _known_env(name: str, spec: RobotTaskSpec | Origin) -> EnvConfig:
    """Return the environment that a dataset or reward is for; `UsageError` if it cannot be simulated here."""
    from manip_il.collect.environments import is_known

    if not is_known(spec.robot, spec.task, spec.object):
        raise UsageError(f"{name} is for {spec.robot} {spec.task} {spec.object}, which cannot be simulated here")
    return make_config(spec.robot, spec.task, spec.fps, object=spec.object)
