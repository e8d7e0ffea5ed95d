"""The options of `--env.type=manip_il`, in LeRobot's form."""

from __future__ import annotations

import multiprocessing
import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import partial
from typing import Any, override

import gymnasium
import numpy as np
from gymnasium.vector import AsyncVectorEnv, AutoresetMode, SyncVectorEnv, VectorEnv
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.envs import EnvConfig

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import UnknownName, UsageError, silence_ffmpeg_warning
from manip_il.learn.names import OBSERVATIONS
from manip_il.option import option_of
from manip_il.robots.robot import get_robot
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.config import EnvConfig as SimConfig
from manip_il.sim.env import environment_state_names
from manip_il.sim.register import ENV_IDS, TASK_IDS, register_envs
from manip_il.sim.scene import build_scene

PACKAGE = "manip_il"
TASKS = {env_id.removeprefix(f"{PACKAGE}/"): names for env_id, names in ENV_IDS.items()}
ANY_ROBOTS = {env_id.removeprefix(f"{PACKAGE}/"): task for env_id, task in TASK_IDS.items()}
RENDER_MODES = ("rgb_array", "none")
_COMMANDS = ("lerobot.scripts.lerobot_eval", "lerobot.scripts.lerobot_train")
_RENAMED = {"agent_pos": STATE, "environment_state": ENVIRONMENT_STATE, ACTION: ACTION}


@EnvConfig.register_subclass("manip_il")
@dataclass
class ManipILEnv(EnvConfig):
    """One robot at one task, for lerobot-eval and lerobot-train.

    robot: for a task of any robot (`PickPlace-v0`), by name or a YAML; panda where none is said.
    observation: `state` (joints and `environment_state`), `images` (joints and cameras) or `both`. cameras: names
    with commas between. observation_height, observation_width: of their pictures [pixels]. fps, episode_length,
    tolerance, success_steps, object, reward: `control_hz`, `horizon`, ... of `manip_il.sim.config.EnvConfig`.
    render_mode: `none` leaves the films of lerobot-eval black, which needs no OpenGL and no time.

    Raises `UnknownName` for a task, observation, camera or render mode, `UsageError` for a number out of range.
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
    reward: str = option_of(SimConfig, "reward")
    render_mode: str = "rgb_array"
    features: dict[str, PolicyFeature] = field(default_factory=dict)
    features_map: dict[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        for kind, name, known in (
            ("--env.task", self.task or "", {**TASKS, **ANY_ROBOTS}),
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
    def package_name(self) -> str:
        """Namespace of the task's id in gymnasium's registry."""
        return PACKAGE

    @property
    @override
    def gym_kwargs(self) -> dict[str, Any]:
        """Arguments of `gymnasium.make` beside the id."""
        kwargs: dict[str, Any] = {"config": self._simulation(), "render_mode": "rgb_array"}
        cameras = self._cameras()
        return kwargs | ({"cameras": cameras.names, "image_size": cameras.size} if cameras else {})

    @override
    def create_envs(self, n_envs: int, use_async_envs: bool = False) -> dict[str, dict[int, VectorEnv]]:
        """Return {type: {0: n_envs environments}} as LeRobot does, with `render_mode`."""
        make: Callable[[], gymnasium.Env[Any, Any]] = partial(
            make_env, self.gym_id, self.gym_kwargs, film=self.render_mode != "none"
        )
        mode = AutoresetMode.SAME_STEP  # LeRobot reads an episode's last `info` in the step that ends it
        if use_async_envs and n_envs > 1:
            _preload()
            envs = AsyncVectorEnv([make] * n_envs, context="forkserver", autoreset_mode=mode)
        else:
            envs = SyncVectorEnv([make] * n_envs, autoreset_mode=mode)
        return {self.type: {0: envs}}

    def _simulation(self) -> SimConfig:
        name = self.task or ""
        robot, task = TASKS.get(name) or (self.robot or SimConfig.robot, ANY_ROBOTS[name])
        if self.robot and self.robot != robot:
            raise UsageError(
                f"--env.robot is {self.robot!r}, and --env.task={name} is {robot}'s; leave one of them out"
            )
        limits = self.tolerance, self.success_steps, self.episode_length
        return SimConfig(robot, task, self.fps, *limits, self.object, self.reward)

    def _cameras(self) -> CameraConfig | None:
        if self.observation == "state":
            return None
        names = tuple(name.strip() for name in self.cameras.split(","))
        return CameraConfig(names, self.observation_height, self.observation_width)

    def _features(self) -> dict[str, PolicyFeature]:
        """Features by the environment's names; a camera by its column, as LeRobot's recorder wants."""
        simulation, cameras = self._simulation(), self._cameras()
        joints = (len(get_robot(simulation.robot).joint_names),)
        features = {
            ACTION: PolicyFeature(FeatureType.ACTION, joints),
            "agent_pos": PolicyFeature(FeatureType.STATE, joints),
        }
        if self.observation != "images":
            size = len(environment_state_names(build_scene(simulation.robot, simulation.task, simulation.object)))
            features["environment_state"] = PolicyFeature(FeatureType.ENV, (size,))
        if cameras is not None:
            picture = PolicyFeature(FeatureType.VISUAL, (*cameras.size, 3))
            features |= {IMAGES + name: picture for name in cameras.names}
        return features


def _preload() -> None:
    """Have children forked from a process that has imported what they need: each would take seconds for it.

    Python 3.12 means to preload the running command by itself, but does not (its fork server drops the path).
    """
    commands = [name for name in _COMMANDS if name in sys.modules]
    multiprocessing.get_context("forkserver").set_forkserver_preload([*commands, __name__])


class Unfilmed(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Small black pictures where lerobot-eval films, which it cannot be told not to."""

    @override
    def render(self) -> Any:
        return np.zeros((16, 16, 3), dtype=np.uint8)


def make_env(env_id: str, kwargs: dict[str, Any], *, film: bool) -> gymnasium.Env[Any, Any]:
    """Return one environment; in a child process too, where nothing is registered yet."""
    register_envs()
    env = gymnasium.make(env_id, disable_env_checker=True, **kwargs)
    return env if film else Unfilmed(env)


register_envs()
silence_ffmpeg_warning()
