"""`manip-il ppo`: a policy goes on learning from a reward that was learnt from preferences."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.learning import LearningOptions, resumed
from manip_il.cli.preferences import load_reward, reward_folder
from manip_il.errors import UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.algorithms.learning_config import LearningConfig
    from manip_il.algorithms.learning_run import Iteration
    from manip_il.algorithms.run import Watch
    from manip_il.collect.workers import Engine
    from manip_il.sim.config import EnvConfig


@dataclass
class PpoOptions(LearningOptions):
    """Improve a cloned policy by PPO on a reward that was learnt from preferences.

    Episodes go on after success, as the reward says how good every state is. OUTPUT_DIR/best holds the policy with the
    highest validation success, which may be the one that it began with.
    """

    title: ClassVar[str] = "PPO"
    name: ClassVar[str] = "ppo"
    example: ClassVar[str] = "manip-il ppo --init=runs/cloned --reward=runs/reward --output_dir=runs/ppo"
    reward: Path | None = option(None, "the reward: a folder of manip-il preferences fit [required]")
    output_dir: Path = option(Path("runs/ppo"), "folder of the run")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        super().check()
        for name, value, what in (
            ("init", self.init, "the run of a cloned mlp"),
            ("reward", self.reward, "a folder of manip-il preferences fit"),
        ):
            if value is None:
                raise UsageError(f"--{name} is missing; expected {what}")

    def environment(self) -> EnvConfig:
        """Return the environment of the reward, which must be the policy's; raises `MismatchError` where it is not."""
        from manip_il.collect.environments import env_spec, is_known
        from manip_il.sim.config import EnvConfig

        assert self.reward is not None
        reward = load_reward(self.reward)
        meta = reward.origin
        if not is_known(meta.robot, meta.task):
            raise UsageError(f"{self.reward} is for {meta.robot} {meta.task}, which cannot be simulated here")
        env = EnvConfig(meta.robot, meta.task, meta.fps, object=meta.object)
        reward.check_fits("the environment", env_spec(env))
        return env

    def iterations(self, config: LearningConfig, folder: Path, engine: Engine, watch: Watch) -> Iterator[Iteration]:
        """Return the run's iterations, the last finished one of a resumed run first."""
        from manip_il.algorithms.learning_run import LearningRun
        from manip_il.algorithms.ppo import ppo

        assert self.reward is not None
        reward = reward_folder(self.reward)
        run = LearningRun(config, folder, engine, watch, absorbing=False, reward=reward)
        return resumed(run, ppo(run, load_reward(self.reward)))
