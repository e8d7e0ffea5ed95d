"""What environments of other packages share: they run unmodified, and MuJoCo's state restores
them.
"""

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from typing import Any, ClassVar, NamedTuple, cast, override

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import MismatchError, UnknownName, UsageError
from manip_il.mdp import F64, State
from manip_il.robots.spec import model_bytes
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.sim.render import LOOK_VERSION as DRAWN
from manip_il.worlds.config import WORLDS, EnvConfig
from manip_il.worlds.contract import (
    Ability,
    Environment,
    EnvironmentSpec,
    Expert,
    Outcome,
    WorldKind,
)
from manip_il.worlds.fingerprint import environment_fingerprint
from manip_il.worlds.table import described_env

WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
TOLERANCE = 0.05  # Fetch's; another environment that reports success by itself ignores it [m]


class PackagedRung(NamedTuple):
    """A phase of an expert.

    Attributes:
        name: Name of the phase.
        holds: Returns whether the rung holds, from what the expert reads from the state.
        target: Returns the rung's target, from the same.
    """

    name: str
    holds: Callable[[Any], bool]
    target: Callable[[Any], Any]


def always(read: object) -> bool:
    """Return True: the rung holds in every state."""
    return True


def coordinates(*names: str) -> tuple[str, ...]:
    """Return the names of the coordinates of vectors."""
    return tuple(f"{name}.{axis}" for name in names for axis in "xyz")


class PackagedEnv(Environment):
    """An environment of another package behind the contract; reset and step are that package's."""

    robot: ClassVar[str]
    action_meaning: ClassVar[str]
    control_hz: ClassVar[int]
    horizon: int
    ends_solved: ClassVar[bool] = False
    can: ClassVar[tuple[Ability, ...]] = ("restored",)
    task: Any  # with its name, its instruction and its phases
    model: mujoco.MjModel
    data: mujoco.MjData
    _env: Any

    def __init__(self, task: str, cameras: CameraConfig | None = None):
        raise NotImplementedError

    @property
    @override
    def spec(self) -> EnvironmentSpec:
        cameras = WORLDS[self.robot].cameras
        return EnvironmentSpec(
            robot=self.robot,
            task=self.task.name,
            fps=self.control_hz,
            joint_names=self.actions.names,
            environment_state_names=self.observed_names(),
            sim_state_size=len(self.get_state().to_vector()),
            instruction=self.task.instruction,
            action_meaning=self.action_meaning,
            phases=self.task.phases,
            horizon=self.horizon,
            can=self.can,
            all_cameras=cameras,
            default_cameras=cameras[:1],
            ends_solved=self.ends_solved,
            shares_model=False,
        )

    def observed_names(self) -> tuple[str, ...]:
        """Return the names of the entries of `environment_state`, (k,)."""
        raise NotImplementedError

    @override
    def start(self, seed: int) -> None:
        self._env.reset(seed=seed)
        self._count_from(0, 0, False)

    @override
    def step(self, action: NDArray[Any]) -> Outcome:
        _, reward, _, _, info = self._env.step(self.actions.clip(action, self._step))
        solved = bool(info["is_success"])
        self._step += 1
        self._streak = self._streak + 1 if solved else 0
        self._ever = self._ever or solved
        return Outcome(action, float(reward), solved)

    @override
    def get_state(self) -> State:
        return State(self._physics(), np.empty(0), self._step, self._streak, self._ever)

    def _physics(self) -> F64:
        """MuJoCo's integration state."""
        physics = np.empty(mujoco.mj_stateSize(self.model, WHOLE))
        mujoco.mj_getState(self.model, self.data, physics, WHOLE)
        return physics

    def _restore(self, state: State, size: int) -> None:
        """Restore the counts, if the state's physics has this many numbers.

        Raise `MismatchError` if not.
        """
        if len(state.physics) != size:
            raise MismatchError(
                "size of the state", "the state", len(state.physics), self.task.name, size
            )
        self._count_from(state.step, state.streak, state.ever)

    def _count_from(self, step: int, streak: int, ever: bool) -> None:
        self._step = step
        self._streak = streak
        self._ever = ever


class Packaged(WorldKind):
    """The environments of another package.

    Args:
        cls: Class of the environments.
        teach: Returns the expert of a task, by its name.
    """

    def __init__(self, cls: type[PackagedEnv], teach: Callable[[str], Expert]):
        self._cls, self._teach = cls, teach
        self._tasks = WORLDS[cls.robot].tasks

    @override
    def complete(self, config: EnvConfig) -> EnvConfig:
        robot = self._cls.robot
        if config.task not in self._tasks:
            raise UnknownName(f"task of {robot}", str(config.task), self._tasks)
        if config.object:
            raise UsageError(
                f"object is {config.object}; {robot} is unmodified, so omit --task.object"
            )
        fixed = {"control_hz": self._cls.control_hz, "tolerance": TOLERANCE, "success_steps": 1}
        for name, value in fixed.items():
            given = getattr(config, name)
            if given not in (0, value):
                raise UsageError(f"{name} is {given:g}; {robot} is unmodified, expected {value:g}")
        settings: dict[str, Any] = {"horizon": config.horizon or self._cls.horizon, **fixed}
        return replace(config, **settings)

    @override
    def environment(
        self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]
    ) -> PackagedEnv:
        """Return the package's environment of a task.

        Args:
            config: Its settings, complete; the package has its own for all but task and horizon.
            cameras: Cameras rendered in every step; None for none.
            conditions: Without ranges, as these environments cannot be varied.
        """
        env = self._cls(str(config.task), cameras)
        env.horizon = config.horizon
        return env

    @override
    def expert(self, config: EnvConfig) -> Expert:
        return self._teach(str(config.task))

    @override
    def drawing_version(self, config: EnvConfig) -> int:
        return DRAWN

    @override
    def own_files(self, spec: Any, shape: str) -> list[str]:
        return [] if spec.task in self._tasks else [f"--task.type={'|'.join(self._tasks)}"]

    @override
    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        settings, described = asdict(config), cast(PackagedEnv, described_env(config))
        del settings["object"]  # there is none
        return environment_fingerprint(model_bytes(described.model), settings)
