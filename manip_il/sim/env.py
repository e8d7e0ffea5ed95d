"""One gymnasium environment for every robot and task, with exact save and restore, and with
conditions.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import cached_property, lru_cache
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import UnknownName, UsageError
from manip_il.mdp import F32, Observation, State
from manip_il.robots.robot import Robot
from manip_il.seeding import rng_for
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CAMERAS, CameraConfig, Episodes, Look, require_cameras
from manip_il.sim.events import Events, draw_posture
from manip_il.sim.render import Picture, pictures, points_in, projections
from manip_il.sim.scene import SCENES_KEPT, build_scene
from manip_il.sim.shape import ANY
from manip_il.sim.task import Task
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import Scene, World

_JOINT_JITTER = 0.03  # largest offset of every arm joint at the start [rad]


class ManipEnv(gymnasium.Env[dict[str, Any], NDArray[Any]]):
    """Joint-position control of one arm on one task. `manip_il.make_env` makes it from names.

    The action is float32 (n,): joint position targets and the gripper command, in the units of
    `ActionSpace`. The observation is a dict of `agent_pos` (n,), `environment_state` (k,) and, with
    cameras, `pixels` {camera: uint8 (H, W, 3)}. The reward is 1 while the task is solved, else 0.
    An episode ends only at the horizon (truncated), so that "solved once" and "solved at the end"
    can both be measured.

    `get_state` returns the true state, without the noise and delay of observations. Everything
    after it depends on the state, the actions and the conditions alone, except that observations
    from before it do not arrive late after `set_state`.

    Attributes:
        world: The scene's physics.
        config: Length and control rate of the episodes, and when they count as solved.
        look: Lighting of pictures.
        cameras: Names of the cameras of observations.
        drawn: Values that the conditions drew for the current episode, by name.
        task: Name of the task.
    """

    metadata: dict[str, Any] = {  # noqa: RUF012
        "render_modes": ["rgb_array"],
        "render_fps": 20,
    }

    def __init__(
        self,
        robot: Robot,
        task: Task,
        config: Episodes,
        *,
        cameras: CameraConfig | None = None,
        look: Look | None = None,
        render_mode: str | None = None,
        conditions: Sequence[Condition] = (),
    ):
        """Build the scene, or take it from the cache.

        Args:
            robot: The robot.
            task: The task.
            config: Length and control rate of the episodes, and when they count as solved.
            cameras: Cameras of observations; None: no pictures.
            look: Lighting of `render`'s pictures; by default that of `cameras`.
            render_mode: `rgb_array`; None: `render` returns None.
            conditions: How episodes differ from the nominal world; they take turns by seed.

        Raises:
            UnknownName: If there is no such camera or render mode.
            UsageError: If the scene cannot be built.
        """
        self.look, self._view = look or (cameras.look if cameras else Look()), cameras
        self.config = config
        self.world = World(build_scene(robot, task, config.physics_step))
        self._task = self.world.scene.task
        self._conditions: tuple[Condition, ...] = ()
        self._begin(0)  # nothing is drawn before an episode starts
        self._conditions = tuple(conditions)
        require_cameras(cameras, CAMERAS)
        if render_mode not in (None, *self.metadata["render_modes"]):
            raise UnknownName("render_mode", render_mode, self.metadata["render_modes"])
        self.render_mode = render_mode
        self.cameras = cameras.names if cameras else ()
        self.metadata = self.metadata | {"render_fps": self.config.control_hz}
        self._max_episode_steps = self.config.horizon
        self.task = task.name
        turn = 2 * np.pi if robot.lerobot is None else 360.0  # for a joint without limits
        low, high = (
            np.nan_to_num(end, posinf=turn, neginf=-turn).astype(np.float32)
            for end in (self.scene.actions.low, self.scene.actions.high)
        )
        self.action_space = gymnasium.spaces.Box(low, high, dtype=np.float32)
        sizes = {
            "agent_pos": len(robot.joint_names),
            "environment_state": len(environment_state_names(self.scene)),
        }
        spaces: dict[str, gymnasium.Space[Any]] = {
            name: gymnasium.spaces.Box(-np.inf, np.inf, (size,), np.float32)
            for name, size in sizes.items()
        }
        if cameras:
            picture = gymnasium.spaces.Box(0, 255, (*cameras.size, 3), np.uint8)
            spaces["pixels"] = gymnasium.spaces.Dict(dict.fromkeys(self.cameras, picture))
        self.observation_space = gymnasium.spaces.Dict(spaces)

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[dict[str, Any], dict[str, Any]]:
        """Draw a start. The same seed gives the same start, bit for bit.

        Args:
            seed: Seed of the episode; None: drawn from the generator of the last seed given.
            options: Not used.

        Returns:
            The first observation, and the infos `is_success`, `ever_success` and `distance` [m].
        """
        super().reset(seed=seed)
        self.start(int(self.np_random.integers(2**62)) if seed is None else seed)
        return self._observation(), self._info()

    @property
    def task_description(self) -> str:
        """Text of the episode for policies that read language."""
        return self._task.instruction_in(self.world)

    @property
    def scene(self) -> Scene:
        """Compiled scene, shared by all environments with the same robot, task and physics step."""
        return self.world.scene

    @property
    def data(self) -> mujoco.MjData:
        """MuJoCo's current data."""
        return self.world.data

    def start(self, seed: int) -> None:
        """Start the episode of a seed: `reset` without making an observation."""
        world, scene = self.world, self.scene
        rng = rng_for(seed, "reset")
        self._begin(seed)
        world.vary(with_drawn(scene.nominal, self.drawn))
        data, home = world.data, np.asarray(scene.robot.home)
        mujoco.mj_resetData(world.model, data)
        for name, pose in self._task.draw(rng, world).poses.items():
            world.place(name, *pose)
        posture = home + rng.uniform(-1, 1, len(home)) * _JOINT_JITTER
        data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = posture
        scene.gripper.put(data, rng.uniform(scene.gripper.least, scene.gripper.most))
        if servos := scene.servos:
            drawn = servos.draw(rng_for(seed, "servos"), self.drawn.get("servo", 0.0))
            servos.begin(world.model, data, drawn)
        if largest := self.drawn.get("posture"):
            draw_posture(world, rng_for(seed, "posture"), largest)
        world.update()
        mujoco.mj_forward(world.model, data)

    def _begin(self, seed: int) -> None:
        """Reset counters, events and observations for the episode of a seed."""
        self._seed = seed
        drawn = draw(self._conditions, seed, ANY if self.scene.draws_shape else "")
        self.drawn = drawn
        self._step = 0
        self._streak = 0
        self._ever = False
        self._begun = False
        self._events = Events(self.world, drawn, seed)
        self._delay = drawn.get("delay", 0)
        self._seen: deque[Observation] = deque(
            maxlen=self._delay + drawn.get("picture_delay", 0) + 1
        )

    def step(
        self, action: NDArray[Any]
    ) -> tuple[dict[str, Any], float, bool, bool, dict[str, Any]]:
        """Apply one action for one control step.

        Args:
            action: The action, (n,).

        Returns:
            The observation, the reward, False (no episode ends early), whether the horizon is
            reached, and the infos as in `reset`.

        Raises:
            NotFiniteError: If the action has NaN or infinite entries.
            MismatchError: If it has the wrong shape.
        """
        self.advance(action)
        reward, info = self.reward, self._info()
        return self._observation(), reward, False, self._step >= self.config.horizon, info

    def _begin_step(self) -> None:
        """Apply the events of the control step that begins, once: a knock, a perturbation.

        A perturbation resets the count of steps within the tolerance.
        """
        if not self._begun and self._events.before(self._step):
            self._streak = 0
        self._begun = True

    def advance(self, action: NDArray[Any]) -> NDArray[Any]:
        """Apply one action for one control step, without making an observation.

        Args:
            action: The action, (n,).

        Returns:
            The action as changed by events, before clipping, (n,).

        Raises:
            NotFiniteError: If the action has NaN or infinite entries.
            MismatchError: If it has the wrong shape.
        """
        self._begin_step()
        scene, data = self.scene, self.data
        executed = self._events.action(action, self._step)
        action = scene.actions.clip(executed, self._step)
        joints, opening = scene.actions.split(action)
        goal = np.append(joints, scene.gripper.command(opening))
        if servos := scene.servos:
            self.simulate(lambda: servos.command(self.world.model, data, goal))
        else:
            data.ctrl[scene.arm_ctrl], data.ctrl[scene.gripper.ctrl] = np.split(goal, [len(joints)])
            self.simulate()
        return executed

    def simulate(self, before: Callable[[], None] | None = None) -> None:
        """Run one control step with the actuators' commands as they are.

        `advance` calls this once it has set them.

        Args:
            before: Called before every physics step, to change the commands.
        """
        self._begin_step()
        pieces = self.config.physics_steps if before else 1
        for _ in range(pieces):
            if before:
                before()
            mujoco.mj_step(self.world.model, self.data, self.config.physics_steps // pieces)
        self.world.update()  # otherwise poses are those at the start of the last physics step
        self._step += 1
        self._begun = False
        self._streak = self._streak + 1 if self.distance() < self.config.tolerance else 0
        self._ever = self._ever or self.solved

    @property
    def solved(self) -> bool:
        """Whether the task has been within its tolerance for enough steps in a row."""
        return self._streak >= self.config.success_steps

    @property
    def reward(self) -> float:
        """Reward of the last control step: 1 if the task is solved, else 0."""
        return float(self.solved)

    def distance(self) -> float:
        """Return how far the task is from being solved [m]."""
        return self._task.error(self.world)

    @property
    def progress(self) -> float:
        """Share of the task that is done, 0 to 1."""
        return min(1.0, max(0.0, self._task.progress(self.world)))

    def get_state(self) -> State:
        """Return everything that the world's future depends on.

        `set_state` restores it bit for bit.
        """
        return State(
            self.world.physics(),
            self.world.variation.copy(),
            self._step,
            self._streak,
            self._ever,
            self._seed,
            self._begun,
        )

    def set_state(self, state: State) -> None:
        """Restore a state of the same scene.

        Args:
            state: The state; one without a seed goes on with the events of the current episode.

        Raises:
            MismatchError: If the state is one of another scene.
        """
        self.world.restore(state.physics, state.variation)
        if state.seed is not None:
            self._begin(state.seed)
        self._step = state.step
        self._streak = state.streak
        self._ever = state.ever
        self._begun = state.begun
        self._seen.clear()

    def observe(self) -> Observation:
        """Return what a policy observes now, with the episode's delay and noise.

        Call it once per control step.

        What happens to the world at the beginning of the control step, such as a knock, has
        happened then. The observation has pictures only if the environment has cameras.
        """
        self._begin_step()
        world = self._measured()
        images: dict[str, Picture] = {}
        keypoints: dict[str, F32] = {}
        if self._view:
            images = self._pictures(self._view)
            if points := [*points_in(self.world).values()]:
                keypoints = projections(self.scene, self._view, np.stack(points))
        state, text = world.measured.astype(np.float32), self.task_description
        self._seen.append(Observation(state, environment_state(world), images, text, keypoints))
        late, first = self._seen[-1 - min(self._delay, len(self._seen) - 1)], self._seen[0]
        return replace(late, images=first.images, keypoints=first.keypoints)

    def _measured(self) -> World:
        """The world with noise on joints and object positions, and on all that depends on them."""
        joints, position = (self.drawn.get(name, 0.0) for name in ("joint_noise", "position_noise"))
        if not joints and not position:
            return self.world
        scene, world = self.scene, self._sensed
        rng = rng_for(self._seed, "observation noise", self._step)
        world.restore(self.world.physics(), self.world.variation)
        world.data.qpos[scene.arm_q] += rng.normal(0.0, joints, len(scene.arm_q))
        for one in scene.objects.values():
            world.data.qpos[one.q : one.q + 3] += rng.normal(0.0, position, 3)
        world.update()
        return world

    @cached_property
    def _sensed(self) -> World:
        return World(self.scene)

    def render(self) -> Picture | None:  # pyright: ignore[reportIncompatibleMethodOverride]
        """Return a picture from the front camera, uint8 (480, 640, 3).

        None unless render_mode is `rgb_array`.
        """
        if self.render_mode is None:
            return None
        return self._pictures(CameraConfig(("front",), 480, 640, self.look))["front"]

    def _pictures(self, cameras: CameraConfig) -> dict[str, Picture]:
        return pictures(self.scene, self.data, cameras, self.world.variation)

    def _info(self) -> dict[str, Any]:
        return {"is_success": self.solved, "ever_success": self._ever, "distance": self.distance()}

    def _observation(self) -> dict[str, Any]:
        seen = self.observe()
        observation: dict[str, Any] = {
            "agent_pos": seen.state,
            "environment_state": seen.environment_state,
        }
        if self.cameras:
            observation["pixels"] = seen.images
        return observation


def environment_state(world: World) -> F32:
    """Return the numbers that the task observes, float32 (k,); lengths in [m]."""
    return np.hstack([*world.scene.task.observe(world).values()]).astype(np.float32)


@lru_cache(SCENES_KEPT)
def environment_state_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of the k entries of `environment_state`."""
    world, names = World(scene), list[str]()
    world.update()
    for name, value in scene.task.observe(world).items():
        shape = np.shape(value)
        if shape not in ((), (3,)):
            raise UsageError(
                f"observe of task {scene.task.name}: {name} has shape {shape}; expected a number or"
                " (3,)"
            )
        names += [f"{name}.{axis}" for axis in "xyz"] if shape else [name]
    return tuple(names)
