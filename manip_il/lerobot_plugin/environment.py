"""The options of `--env.type=manip_il`, in LeRobot's form."""

import multiprocessing
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, override

import gymnasium
import numpy as np
from gymnasium.vector import VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE
from manip_il.errors import UnknownName, UsageError, silence_ffmpeg_warning
from manip_il.learn.names import OBSERVATIONS
from manip_il.option import NameOrPath, option_of, typed
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.env import ManipEnv
from manip_il.tasks import ENV_IDS, TASK_IDS
from manip_il.worlds.config import EnvConfig as SimConfig
from manip_il.worlds.ladder.world import parts_of
from manip_il.worlds.table import complete, env_spec

TASKS = {env_id.removeprefix("manip_il/"): names for env_id, names in ENV_IDS.items()}
ANY_ROBOTS = {env_id.removeprefix("manip_il/"): task for env_id, task in TASK_IDS.items()}
RENDER_MODES = ("rgb_array", "none")
_ID = "manip_il/LeRobot-v0"
_COMMANDS = ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train")
_RENAMED = {"agent_pos": STATE, "environment_state": ENVIRONMENT_STATE}


@EnvConfig.register_subclass("manip_il")
@dataclass
class ManipILEnv(EnvConfig):
    """One robot at one task, for lerobot-eval and lerobot-train.

    A file with a task or a robot is opened only if it is named on the command line or, in Python,
    by a `Path`; not if a file of options names it.

    Attributes:
        task: A name in gymnasium (`PandaPickPlace-v0`, `PickPlace-v0`), or the path of a file with
            a task of your own.
        robot: For tasks of any robot (`PickPlace-v0`, a file), a name or YAML file; by default
            panda.
        fps: `control_hz` of `manip_il.sim.config.EnvConfig`.
        observation: `state` (joints and `environment_state`), `images` (joints and cameras) or
            `both`.
        cameras: Comma-separated names.
        observation_height: Height of the pictures [pixels].
        observation_width: Width of the pictures [pixels].
        episode_length: `horizon` of `manip_il.sim.config.EnvConfig`.
        tolerance: As in `manip_il.sim.config.EnvConfig`.
        success_steps: As in `manip_il.sim.config.EnvConfig`.
        object: As in `manip_il.sim.config.EnvConfig`.
        render_mode: `rgb_array` or `none`. With `none` lerobot-eval's films are black, which needs
            no OpenGL and hardly any time.

    Raises:
        UnknownName: The task, the observation, a camera or the render mode is unknown.
        UsageError: A number is out of range, or the task is for another robot.
    """

    task: str | None = "PandaPickPlace-v0"
    robot: str = ""
    fps: int = option_of(SimConfig, "control_hz")
    observation: str = "state"
    cameras: str = ",".join(CAMERAS)
    observation_height: int = option_of(CameraConfig, "height")
    observation_width: int = option_of(CameraConfig, "width")
    episode_length: int = option_of(SimConfig, "horizon")
    tolerance: float = option_of(SimConfig, "tolerance")
    success_steps: int = option_of(SimConfig, "success_steps")
    object: str = option_of(SimConfig, "object")
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("--env.observation", self.observation, OBSERVATIONS),
            ("--env.render_mode", self.render_mode, RENDER_MODES),
        ):
            if name not in known:
                raise UnknownName(kind, name, known)
        self.fps = self._simulation().control_hz
        self.features = self._features()
        self.features_map = {key: _RENAMED.get(key, key) for key in self.features}

    @property
    @override
    def gym_id(self) -> str:
        """Id in gymnasium's registry, the same for all tasks: robot and task are arguments."""
        return _ID

    @property
    @override
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make` besides the id."""
        return {
            "config": self._simulation(),
            "film": self.render_mode != "none",
            "cameras": self._cameras(),
        }

    @override
    def create_envs(
        self, n_envs: int, use_async_envs: bool = False
    ) -> dict[str, dict[int, VectorEnv]]:
        """Return the environments in LeRobot's form.

        With `use_async_envs` their processes are forked from a server that has done the slow
        imports. Python 3.12 should preload the running command by itself, but its fork server loses
        the path of that command.

        Args:
            n_envs: The number of environments.
            use_async_envs: Whether each environment has its own process.
        """
        commands = [name for name in _COMMANDS if name in sys.modules]
        multiprocessing.get_context("forkserver").set_forkserver_preload([*commands, __name__])
        return super().create_envs(n_envs, use_async_envs)

    def _simulation(self) -> SimConfig:
        name, robot = _given(self.task or ""), self.robot or SimConfig.robot
        base, colon, argument = str(name).partition(":")
        if base not in TASKS and base not in ANY_ROBOTS and not isinstance(name, Path):
            raise UnknownName("--env.task", name, {**TASKS, **ANY_ROBOTS})
        robot, task = TASKS.get(base) or (robot, ANY_ROBOTS.get(base, base))
        if self.robot and self.robot != robot:
            raise UsageError(
                f"--env.robot is {self.robot!r}, but --env.task={name} is for {robot}; leave one of"
                " them out"
            )
        task = type(name)(task + colon + argument)
        limits = self.tolerance, self.success_steps, self.episode_length
        return complete(SimConfig(self.fps, *limits, _given(robot), task, _given(self.object)))

    def _cameras(self) -> CameraConfig | None:
        if self.observation == "state":
            return None
        names = tuple(name.strip() for name in self.cameras.split(","))
        return CameraConfig(names, self.observation_height, self.observation_width)

    def _features(self) -> dict[str, PolicyFeature]:
        """Return the features by observation name, but cameras by column, as LeRobot's recorder
        requires.
        """
        cameras = self._cameras()
        spec = env_spec(self._simulation(), cameras)
        joints = (len(spec.joint_names),)
        features = {
            ACTION: PolicyFeature(FeatureType.ACTION, joints),
            "agent_pos": PolicyFeature(FeatureType.STATE, joints),
        }
        if self.observation != "images":
            size = (len(spec.environment_state_names),)
            features["environment_state"] = PolicyFeature(FeatureType.ENV, size)
        picture = PolicyFeature(FeatureType.VISUAL, (*spec.image_size, 3))
        return features | dict.fromkeys(spec.image_keys, picture)


def _given(text: NameOrPath) -> NameOrPath:
    """Return `typed(text)` if the command line has it: LeRobot also reads options from files in
    checkpoints.
    """
    return typed(text) if any(f"={word}".endswith(f"={text}") for word in sys.argv) else text


class FilmedEnv(ManipEnv):
    """`ManipEnv` for lerobot-eval, which always films.

    Args:
        config: The options of the environment.
        film: Whether to render the films; if not, their pictures are small and black.
        cameras: The cameras that the policy observes; None for none.
        gymnasiums: Further arguments of `ManipEnv`.
    """

    def __init__(
        self, config: SimConfig, *, film: bool, cameras: CameraConfig | None, **gymnasiums: Any
    ):
        super().__init__(
            *parts_of(config), config, cameras=cameras, render_mode="rgb_array", **gymnasiums
        )
        self._film = film

    @override
    def render(self) -> Any:
        return super().render() if self._film else np.zeros((16, 16, 3), np.uint8)


if _ID not in gymnasium.registry:
    gymnasium.register(_ID, entry_point=FilmedEnv)
silence_ffmpeg_warning()
