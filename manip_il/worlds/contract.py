"""The contract of a world, whoever made it: an environment, an expert, and how they are made from
names.

A world gives its environments and experts as these classes say; what it cannot do stands in its
`EnvironmentSpec`.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError, UsageError
from manip_il.mdp import F64, IMAGES, KEYPOINTS, Label, Observation, State
from manip_il.option import NameOrPath
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig, require_cameras
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.fingerprint import canonical_json

OPENINGS = "joint position targets [rad], gripper opening command [m]"
# as in LeRobot's recorder
SERVOS = "joint position targets [deg], gripper position command [0 to 100]"
OWN_ACTIONS = "action of the environment"
TWO_ARMS = "joint position targets [rad], gripper command [0 to 1], of two arms"
JOINT_TARGETS = (OPENINGS, SERVOS, TWO_ARMS)
# action meaning -> indices of the grippers in state and action; by default the last
GRIPPERS = {TWO_ARMS: (6, 13)}
# version of the columns and their meaning: 2 has progress, complete states and named phases
VERSION = 2
UNNAMED = ("none", "act")  # phases of experts that name none
# keys of a spec's JSON that may be missing
_OPTIONAL = ("object", "robot_type", "video", "keypoints", "state_names", "expert")

Ability = Literal["restored", "varied", "redrawn", "perturbed", "drawn", "shown in a window"]
"""What can be done with an environment.

`restored`: its states, so that they can be labelled and drawn again. `varied`: its physics,
appearance and noise, by `Condition`. `redrawn`: new scenes from visited states. `perturbed`: its
objects moved by `robot certify`. `drawn`: by cameras. `shown in a window`: in MuJoCo's viewer.
"""


def _not_stored(default: Any) -> Any:
    return field(default=default, compare=False)


@dataclass(frozen=True)
class EnvironmentSpec:
    """Names, sizes and rate that a dataset, a policy and an environment must share, and what an
    environment can do.

    Names of robot, task and cameras are safe in paths. Raises `ManipError` naming an invalid value.
    """

    robot: str
    task: str
    fps: float  # control rate [Hz], an int if it is whole
    joint_names: tuple[str, ...]  # n: arm joints, then the gripper
    environment_state_names: tuple[str, ...]  # k
    sim_state_size: int  # m
    instruction: str  # LeRobot's `task` text

    action_meaning: str = OPENINGS
    cameras: tuple[str, ...] = ()
    # height, width [pixels] of every camera; (0, 0) without cameras
    image_size: tuple[int, int] = (0, 0)
    # name of each value of `expert_phase`: "none", then the rungs of the task's ladder
    phases: tuple[str, ...] = ()
    object: str = ""  # shape and size of the object that the task moves; empty for the task's own
    robot_type: str = ""  # LeRobot's name of the robot; empty if the same as `robot`
    # whether pictures are in video files; otherwise they are PNGs in the data files
    video: bool = True
    # points of the scene whose image coordinates are columns, for every camera
    keypoints: tuple[str, ...] = ()
    # names of the numbers of `observation.state`; empty if they are those of the action
    state_names: tuple[str, ...] = ()
    # whether the expert is a function of the state, or keeps memory within an episode
    expert: Literal["stateless", "recurrent"] = "stateless"
    schema: int = VERSION

    # Of an environment alone: neither stored in datasets and checkpoints, nor compared
    horizon: int = _not_stored(0)  # most control steps of an episode
    can: tuple[Ability, ...] = _not_stored(())
    all_cameras: tuple[str, ...] = _not_stored(())  # names of the cameras that can draw it
    # those that draw it if none are named; the first one films
    default_cameras: tuple[str, ...] = _not_stored(())
    points: tuple[str, ...] = _not_stored(())  # keypoints that cameras would see
    # whether it ends solved episodes by itself; None: as the caller asks
    ends_solved: bool | None = _not_stored(None)
    # whether environments in one process share one compiled model
    shares_model: bool = _not_stored(True)
    has_progress: bool = _not_stored(True)  # whether `progress` says more than `solved`
    drawing_version: int = _not_stored(0)  # a number that changes when pictures do

    def __post_init__(self) -> None:
        checks.name("robot", self.robot)
        checks.task_name(self.task)
        object.__setattr__(self, "fps", plain_rate(checks.number("fps", self.fps, 1)))
        checks.object_name(self.object)
        for camera in self.cameras:
            checks.name("a camera", camera)

    def to_json(self) -> dict[str, Any]:
        """Return the stored fields as JSON types, without optional keys that have their default."""
        values = {one.name: getattr(self, one.name) for one in fields(self) if one.compare}
        values = {
            key: list(value) if isinstance(value, tuple) else value for key, value in values.items()
        }
        values |= {
            "video": None if self.video else False,
            "keypoints": list(self.keypoints) or None,
            "state_names": list(self.state_names) or None,
            "expert": None if self.expert == "stateless" else self.expert,
        }
        return {
            key: value
            for key, value in values.items()
            if value not in ("", None) or key not in _OPTIONAL
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EnvironmentSpec:
        """Return the spec that `to_json` wrote.

        Raises `ManipError` for an older schema, `TypeError` for other keys.
        """
        if (found := data.get("schema", 1)) != VERSION:
            raise ManipError(
                f"written with schema {checks.shorten(found)} of manip_il's columns, but this"
                f" version reads {VERSION}; make it again in another folder, with the same options"
            )
        values: dict[str, Any] = {
            key: tuple(one) if isinstance(one, list) else one for key, one in data.items()
        }
        return cls(**values)

    @property
    def observed_names(self) -> tuple[str, ...]:
        """Names of the numbers of `observation.state`."""
        return self.state_names or self.joint_names

    @property
    def image_keys(self) -> dict[str, str]:
        """Columns of pictures: column -> camera."""
        return {IMAGES + camera: camera for camera in self.cameras}

    @property
    def keypoint_keys(self) -> dict[str, str]:
        """Columns of keypoints: column -> camera; {} if there are no keypoints."""
        return {KEYPOINTS + camera: camera for camera in self.cameras if self.keypoints}

    def look_sha256(self, cameras: CameraConfig) -> str:
        """Return the hash of what determines the pictures of cameras, besides the state."""
        look = f"{canonical_json(cameras)} {self.drawing_version}"
        return hashlib.sha256(look.encode()).hexdigest()

    def require(self, ability: Ability, advice: str) -> None:
        """Raise `Unable` unless the environment has an ability.

        Args:
            ability: What is to be done with the environment.
            advice: What the user should do instead, for the message.
        """
        if ability not in self.can:
            raise Unable(f"{self.robot} cannot be {ability}; {advice}")

    def require_cameras(self, cameras: CameraConfig | None) -> None:
        """Raise `Unable` if no camera can draw the environment, `UnknownName` for a camera that
        it does not have.
        """
        if cameras is not None:
            self.require("drawn", f"omit --cameras={','.join(cameras.names)}")
            require_cameras(cameras, self.all_cameras)


def plain_rate(fps: float) -> float:
    """Return a rate as `info.json` has it: an int if it is whole."""
    return int(fps) if float(fps).is_integer() else fps


class Unable(UsageError):
    """An environment cannot do what is asked of it, as its spec says."""


class Outcome(NamedTuple):
    """What one control step did: the action as executed, before clipping (n,), its reward, success
    after it, and whether the environment has ended the episode.

    `executed` is the given array itself unless the environment changed it.
    """

    executed: NDArray[Any]
    reward: float
    solved: bool
    ended: bool = False


class Environment(Protocol):
    """One episode at a time of a robot at a task."""

    actions: ActionSpace

    @property
    def spec(self) -> EnvironmentSpec:
        """Names, sizes and rate, and what the environment can do."""
        ...

    @property
    def progress(self) -> float:
        """Share of the task that is done in the present state, 0 to 1."""
        ...

    def start(self, seed: int) -> None:
        """Begin the episode of a seed; the same seed gives the same start, bit for bit."""
        ...

    def observe(self) -> Observation:
        """Return what a policy observes now; once per control step, before its state is read."""
        ...

    def step(self, action: NDArray[Any]) -> Outcome:
        """Apply one action (n,) for one control step. Raises `NotFiniteError`, `MismatchError`."""
        ...

    def get_state(self) -> State:
        """Return everything that the future depends on."""
        ...

    def set_state(self, state: State) -> None:
        """Restore a state bit for bit, if the environment can be `restored`.

        Raises `MismatchError` for a state of another scene.
        """
        ...

    def positions(self) -> dict[str, F64]:
        """Return true positions (3,) [m] of `hand` and objects, of which the first one to reach
        is called `object`.
        """
        ...

    def subtask(self, phase: int) -> str:
        """Return what the expert does in a phase of the present state, in words; "" if there are
        none.
        """
        name = self.spec.phases[phase]
        return "" if name in UNNAMED else name.replace("_", " ")

    def noun(self, name: str) -> str:
        """Return the words for a position or a point of a given name."""
        return name.replace("_", " ")

    def facts(self) -> list[tuple[str, str, Any]]:
        """Return what is true of the present state: words for a thing, an attribute, its value."""
        found = self.positions()
        hand = found.pop("hand", None)
        return [
            (self.noun(name), "distance to the hand [cm]", round(100 * math.dist(at, hand)))
            for name, at in found.items()
            if hand is not None
        ]

    def varied(self, state: State, drawn: Mapping[str, Any]) -> State:
        """Return a state with other values of what `Condition` draws, if the environment can be
        `varied`.
        """
        return state

    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        """Return a new scene made from a state, if it can be `redrawn`.

        None if the drawn places overlap.
        """
        return None


class Expert(Protocol):
    """Labels any state; the same state gives bit-equal labels in any order and process."""

    def label(self, state: State, environment: Environment | None = None) -> Label:
        """Return the expert's action (n,) in a state.

        Args:
            state: The state to label.
            environment: One that is already in this state; it is only read.

        Raises:
            MismatchError: for a state of another scene.
        """
        ...


class WorldKind:
    """Environments and experts of one origin, made from the names of robot and task."""

    def tasks_in(self, task: NameOrPath) -> tuple[NameOrPath, ...]:
        """Return the tasks that a text names, `lift,stack`; each of them once."""
        return checks.tasks_in(task) if isinstance(task, str) else (task,)

    def complete(self, config: EnvConfig) -> EnvConfig:
        """Return settings with 0 and empty values filled in. Raises `UsageError`, `UnknownName`."""
        raise NotImplementedError

    def environment(
        self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]
    ) -> Environment:
        """Return an environment, which can do what `cameras` and `conditions` need.

        Args:
            config: Its settings, complete.
            cameras: Cameras rendered in every step; None for none.
            conditions: How episodes differ from the nominal world, in turn by seed.
        """
        raise NotImplementedError

    def expert(self, config: EnvConfig) -> Expert:
        """Return the expert of an environment."""
        raise NotImplementedError

    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        """Return versions and hashes of everything that determines the environment's numbers."""
        raise NotImplementedError

    def lerobot_words(self, robot: str, task: str) -> list[str]:
        """Return the options of `lerobot-eval` for this environment; [] if it cannot run there."""
        return []

    def affecting(self, config: EnvConfig, condition: Condition, *, sees: bool) -> Condition | None:
        """Return the part of a condition that changes something.

        Args:
            config: Settings of the environment.
            condition: Ranges of what differs from the nominal world.
            sees: Whether the policy has cameras.

        Returns:
            The condition without ranges that have no effect; None if it had some and none is left.
        """
        return None if condition.ranges else condition
