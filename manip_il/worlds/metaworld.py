"""Meta-World's fifty tasks as LeRobot's environment makes them, labelled by the package's scripts
and, where these fail, by `metaworld_experts`.

Yu et al. 2019, "Meta-World: A benchmark and evaluation for multi-task and meta reinforcement
learning". What is trained here is measured by `lerobot-eval --env.type=metaworld`.
"""

from __future__ import annotations

import pickle
import warnings
from functools import cache
from importlib import import_module
from importlib.resources import files
from pathlib import Path
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import requires
from manip_il.mdp import F64
from manip_il.sim.config import CameraConfig
from manip_il.worlds.gym.drawing import painted
from manip_il.worlds.gym.environment import GymKind
from manip_il.worlds.gym.restoring import simulation
from manip_il.worlds.gym.world import AGENT, AROUND, GymWorld
from manip_il.worlds.metaworld_experts import EXPERTS

CAMERA, CAMERA_AT = "corner2", (0.75, 0.075, 0.7)  # LeRobot's place of it [m]
ROBOT = 4  # numbers of the observation that are the robot's: hand (3,) [m], and gripper


@cache
def _known() -> dict[str, Any]:
    """Return LeRobot's tables of the tasks: texts, difficulties, scripts."""
    table = files("lerobot") / "envs/metaworld_config.json"
    return checks.read_json(Path(str(table)), "LeRobot's table of tasks")


class Metaworld(GymWorld):
    """One of the fifty tasks, on its own robot, a Sawyer."""

    name = "metaworld"
    fps = 80
    horizon = 500
    cameras = (CAMERA,)

    @override
    def make(self) -> Any:
        # its scripts warn of commands that they expect to be clipped
        warnings.filterwarnings("ignore", module=r"metaworld\.")
        with requires("metaworld", "'manip_il[metaworld]'"):
            metaworld = import_module("metaworld")
            scripts = import_module("metaworld.policies")
        cls = metaworld.ALL_V3_ENVIRONMENTS[self.task]
        env = cls(render_mode="rgb_array", camera_name=CAMERA)
        # As a task of `MT1`, which takes seconds to draw 50 starts. None of these is needed.
        settings = {"env_cls": cls, "partially_observable": False, "rand_vec": None}
        env.set_task(metaworld.Task(self.task, pickle.dumps(settings)))
        env.model.camera(CAMERA).pos[:] = CAMERA_AT
        env._freeze_rand_vec = False
        env.seeded_rand_vec = True
        self.instruction = _known()["TASK_DESCRIPTIONS"][self.task]
        self._script = getattr(scripts, _known()["TASK_POLICY_MAPPING"][self.task])()
        return env

    @override
    def reset(self, env: Any, seed: int) -> tuple[F64, dict[str, Any]]:
        env.seed(seed)
        return env.reset(seed=seed)

    @override
    def observe(self, env: Any, seen: F64) -> dict[str, F64]:
        return {AGENT: seen[:ROBOT], AROUND: seen[ROBOT:]}

    @override
    def act(self, env: Any, seen: F64) -> F64:
        if own := EXPERTS.get(self.task):
            return own(seen)
        return np.clip(self._script.get_action(seen), -1.0, 1.0)

    @override
    def positions(self, env: Any) -> dict[str, F64]:
        return {"hand": env.tcp_center, "object": env._get_pos_objects()[:3]}

    @override
    def render(self, env: Any, camera: str, cameras: CameraConfig) -> NDArray[np.uint8]:
        simulated = simulation(env)
        assert simulated is not None
        # LeRobot turns its pictures by half a turn
        return painted(type(self), self.task, simulated, camera, cameras)[::-1, ::-1]


Metaworld.tasks = tuple(_known()["TASK_POLICY_MAPPING"])
Metaworld.groups = {name: tuple(tasks) for name, tasks in _known()["DIFFICULTY_TO_TASKS"].items()}


class MetaworldKind(GymKind):
    """Meta-World's tasks, which LeRobot's evaluator also runs."""

    @override
    def lerobot_words(self, robot: str, task: str) -> list[str]:
        return ["--env.type=metaworld", f"--env.task={task}"]


WORLD = MetaworldKind(Metaworld)
