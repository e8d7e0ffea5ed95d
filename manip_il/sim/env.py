"""One gymnasium environment for every robot and task, with exact save and restore."""

from __future__ import annotations

from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import Observation, State
from manip_il.seeding import rng_for
from manip_il.sim.config import EnvConfig
from manip_il.sim.look import PLAIN, CameraConfig, Look
from manip_il.sim.observe import environment_state, environment_state_names, joint_state
from manip_il.sim.render import Picture, pictures
from manip_il.sim.scene import build_scene
from manip_il.sim.world import Scene, World

F64 = NDArray[np.float64]
_JOINT_JITTER = 0.03  # of every arm joint at the start [rad]


class ManipEnv(gymnasium.Env[dict[str, Any], NDArray[Any]]):
    """Joint-position control of one arm on one task.

    Action: joint position targets [rad] and gripper opening command [m], (n,), float32. Observation: a dict of
    `agent_pos` (n,), `environment_state` (k,) and, with cameras, `pixels` {camera: uint8 (H, W, 3)}.
    Reward is 1 while the task is solved, else 0. An episode ends at the horizon only (truncated), so that
    "solved once" and "solved at the end" can both be told. Raises `UnknownName` for a robot, task or camera,
    `UsageError` for a size of pictures that `CameraConfig` refuses.
    """

    metadata: dict[str, Any] = {"render_modes": ["rgb_array"], "render_fps": 20}  # noqa: RUF012

    def __init__(
        self,
        robot: str = "panda",
        task: str = "pick_place",
        *,
        config: EnvConfig | None = None,
        cameras: tuple[str, ...] = (),
        image_size: tuple[int, int] = (128, 128),
        look: Look | None = None,
        render_mode: str | None = None,
        **settings: Any,
    ):
        self.look, self.appearance = look or Look(), PLAIN
        self._view = CameraConfig(tuple(cameras), *image_size, self.look) if cameras else None
        self.config = config or EnvConfig(robot, task, **settings)
        self.world = World(build_scene(self.config.robot, self.config.task))
        self.render_mode = render_mode
        self.cameras, self.image_size = tuple(cameras), image_size
        self.metadata = self.metadata | {"render_fps": self.config.control_hz}
        self._max_episode_steps = self.config.horizon
        self.task_description = self.scene.task.instruction
        self.task = self.config.task
        self._step = self._streak = 0
        self._ever = False
        self.action_space = _bounded(self.scene.actions.low, self.scene.actions.high)
        self.observation_space = self._observation_space()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Draw a start. The same seed gives the same start, bit for bit."""
        super().reset(seed=seed)
        self.start(int(self.np_random.integers(2**62)) if seed is None else seed)
        return self._observation(), self._info()

    @property
    def scene(self) -> Scene:
        """What is simulated."""
        return self.world.scene

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's data, as they are now."""
        return self.world.data

    def start(self, seed: int) -> None:
        """`reset` without making an observation."""
        world, scene, rng = self.world, self.scene, rng_for(seed, "reset")
        world.vary(self._drawn_variation())
        data, robot = world.data, scene.robot
        mujoco.mj_resetData(world.model, data)
        for name, pose in scene.task.draw(rng, world).poses.items():
            world.place(name, *pose)
        posture = np.asarray(robot.home) + rng.uniform(-1, 1, len(robot.joints)) * _JOINT_JITTER
        data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = posture
        opening = rng.uniform(scene.gripper.least, scene.gripper.most)
        data.qpos[scene.gripper.q] = data.ctrl[scene.gripper.ctrl] = scene.gripper.command(opening)
        self._step = self._streak = 0
        self._ever = False
        world.moved()
        mujoco.mj_forward(world.model, data)

    def _drawn_variation(self) -> F64:
        """What the episode that begins has, (v,)."""
        return self.scene.nominal

    def step(self, action: NDArray[Any]) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply one action for one control step."""
        self.advance(action)
        return self._observation(), float(self.solved), False, self._step >= self.config.horizon, self._info()

    def advance(self, action: NDArray[Any]) -> None:
        """`step` without making an observation. Raises `NotFiniteError`, `MismatchError`."""
        world, scene = self.world, self.scene
        action = scene.actions.clip(action, self._step)
        data = world.data
        data.ctrl[scene.arm_ctrl] = action[scene.actions.arm]
        data.ctrl[scene.gripper.ctrl] = scene.gripper.command(action[scene.actions.gripper])
        mujoco.mj_step(world.model, data, self.config.physics_steps)
        world.moved()  # positions as of now, not of the last physics step's start
        self._step += 1
        self._streak = self._streak + 1 if self.distance() < self.config.tolerance else 0
        self._ever = self._ever or self.solved

    @property
    def solved(self) -> bool:
        """Within the tolerance for the required steps in a row, now."""
        return self._streak >= self.config.success_steps

    def distance(self) -> float:
        """Return how far the task is from being solved [m]."""
        return self.scene.task.error(self.world)

    @property
    def progress(self) -> float:
        """How much of the task is done, 0 to 1."""
        return min(1.0, max(0.0, self.scene.task.progress(self.world)))

    def get_state(self) -> State:
        """Return everything that the future depends on; `set_state` restores it bit for bit."""
        return State(self.world.physics(), self.world.variation.copy(), self._step, self._streak, self._ever)

    def set_state(self, state: State) -> None:
        """Restore a state of the same scene. Raises `MismatchError` for another scene's."""
        self.world.restore(state.physics, state.variation)
        self._step, self._streak, self._ever = state.step, state.streak, state.ever

    def observe(self) -> Observation:
        """What a learner sees now (pictures only where the environment has cameras)."""
        images = self._pictures(self._view) if self._view else {}
        return Observation(joint_state(self.world), environment_state(self.world), images)

    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture from the front camera, uint8 (480, 640, 3)."""
        if self.render_mode != "rgb_array":
            return None
        return self._pictures(CameraConfig(("front",), 480, 640, self.look))["front"]

    def _pictures(self, cameras: CameraConfig) -> dict[str, Picture]:
        return pictures(self.config.robot, self.config.task, self.data, cameras, self.appearance)

    def _info(self) -> dict[str, Any]:
        return {"is_success": self.solved, "ever_success": self._ever, "distance": self.distance()}

    def _observation(self) -> dict[str, Any]:
        seen = self.observe()
        observation: dict[str, Any] = {"agent_pos": seen.state, "environment_state": seen.environment_state}
        if self.cameras:
            observation["pixels"] = seen.images
        return observation

    def _observation_space(self) -> gymnasium.spaces.Dict:
        n, k = len(self.scene.robot.joint_names), len(environment_state_names(self.scene))
        spaces: dict[str, gymnasium.Space[Any]] = {
            "agent_pos": gymnasium.spaces.Box(-np.inf, np.inf, (n,), np.float32),
            "environment_state": gymnasium.spaces.Box(-np.inf, np.inf, (k,), np.float32),
        }
        if self.cameras:
            picture = gymnasium.spaces.Box(0, 255, (*self.image_size, 3), np.uint8)
            spaces["pixels"] = gymnasium.spaces.Dict(dict.fromkeys(self.cameras, picture))
        return gymnasium.spaces.Dict(spaces)


def _bounded(low: F64, high: F64) -> gymnasium.spaces.Box:
    """The space of actions; a joint that turns freely is told nothing beyond two turns."""
    limits = np.vstack([low, high])
    finite = np.where(np.isfinite(limits), limits, np.sign(limits) * 2 * np.pi).astype(np.float32)
    return gymnasium.spaces.Box(finite[0], finite[1], dtype=np.float32)
