"""Settings of an environment and of its pictures, without the simulator."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from manip_il.errors import UnknownName, UsageError
from manip_il.option import option
from manip_il.robots import ROBOTS
from manip_il.sim.shape import CUBE, SHAPE_HELP, Shape
from manip_il.stock import table as stock
from manip_il.tasks import NAMES
from manip_il.tasks.reward import DEFAULT, REWARD_HELP, TASTES, Reward

DT_SIM = 0.002  # longest step of physics [s]
LIMITS_HZ = 20  # control steps a second that the tasks' own limits are for; at another rate they last as long
ROBOT_HELP = (
    f"{', '.join(ROBOTS)}, the path of the YAML of an arm of your own, or {stock.ROBOT}: "
    "gymnasium-robotics' own Fetch environments, unmodified"
)
TASK_HELP = f"{', '.join(NAMES)}; of {stock.ROBOT} {', '.join(stock.STOCK)}"
MOST_HZ = round(1 / DT_SIM)


@dataclass(frozen=True)
class EnvConfig:
    """Settings of one environment; every field is part of the fingerprint. Raises `UsageError` for a wrong value.

    object: shape and size of what is grasped, as `Shape.parse` reads it; empty for the task's own. reward: of `carry`,
    as `Reward.parse` reads it, kept as its numbers wherever it came from; empty for the task's own.
    """

    robot: str = option("panda", ROBOT_HELP, flag="robot.type")
    task: str = option("pick_place", TASK_HELP, flag="task.type")
    control_hz: int = option(0, "control steps a second; 0: the robot's own, 30 of so101, 20 of others")
    tolerance: float = option(0.0, "distance to the goal that counts as success [m]; 0: the task's own")
    success_steps: int = option(
        0, "consecutive control steps within the tolerance that count as success; 0: the task's own"
    )
    horizon: int = option(0, "control steps in an episode; 0: the task's own")
    object: str = option("", f"{SHAPE_HELP}; by default the task's own", flag="task.object")
    reward: str = option("", f"{REWARD_HELP}; by default {DEFAULT}", flag="task.reward")

    def __post_init__(self) -> None:
        from manip_il.mdp import LONGEST_EPISODE  # here, as help needs no numpy

        if self.robot == stock.ROBOT:
            stock.take_limits(self)
        self._take_object()
        self._take_reward()
        if not self.control_hz:
            from manip_il.robots.table import get_robot  # here, as help needs no robot

            object.__setattr__(self, "control_hz", get_robot(self.robot).fps)
        if not 1 <= self.control_hz <= MOST_HZ:
            raise UsageError(f"control_hz is {self.control_hz}; expected 1 to {MOST_HZ}")
        self._take_limits()
        if not 0 < self.tolerance < 1:
            raise UsageError(f"tolerance is {self.tolerance} m; expected between 0 and 1")
        if self.horizon > LONGEST_EPISODE:
            raise UsageError(f"horizon is {self.horizon}; expected at most {LONGEST_EPISODE} control steps")
        if self.success_steps < 1 or self.horizon < self.success_steps:
            raise UsageError(f"horizon is {self.horizon}; expected at least success_steps ({self.success_steps}) >= 1")

    def _take_object(self) -> None:
        """Say the object as short as can be, the cube that is the default not at all."""
        if not self.object:
            return
        from manip_il.tasks.table import get_task  # here, as help needs no simulator

        shape = Shape.parse(self.object)
        get_task(self.task, self.object)
        object.__setattr__(self, "object", "" if shape == CUBE else str(shape))

    def _take_reward(self) -> None:
        """Say the reward by its numbers, the one that is the default not at all."""
        if not self.reward:
            return
        from manip_il.tasks.table import get_task  # here, as help needs no simulator

        reward = Reward.parse(self.reward)
        get_task(self.task, reward=reward.numbers)
        object.__setattr__(self, "reward", "" if reward == TASTES[DEFAULT] else reward.numbers)

    def _take_limits(self) -> None:
        """Take from the task what is not given."""
        if self.tolerance and self.success_steps and self.horizon:
            return
        from manip_il.tasks.table import get_task  # here, as help needs no simulator

        limits = get_task(self.task, self.object).limits
        rate = self.control_hz / LIMITS_HZ
        found = {
            "tolerance": limits.tolerance,
            "success_steps": max(1, round(limits.success_steps * rate)),
            "horizon": max(1, round(limits.horizon * rate)),
        }
        for name, value in found.items():
            object.__setattr__(self, name, getattr(self, name) or value)

    @property
    def name(self) -> str:
        """Robot and task as one word, the robot by its file's name."""
        return scene_name(self.robot, self.task)

    @property
    def physics_steps(self) -> int:
        """MuJoCo steps in one control step."""
        return -(-MOST_HZ // self.control_hz)

    @property
    def physics_step(self) -> float:
        """Time of one of them: `DT_SIM`, or a little less where that does not divide a control step [s]."""
        return 1 / (self.control_hz * self.physics_steps)


def scene_name(robot: str, task: str) -> str:
    """Return robot and task as one word, the robot by its file's name."""
    return f"{Path(robot).stem}_{task}"


CAMERAS = ("front", "side", "wrist")
MIN_SIDE, MAX_SIDE = 16, 2048  # of a picture [pixels]
_BRIGHTNESS = (0.1, 2.0)


@dataclass(frozen=True)
class Look:
    """Light of a scene; part of a dataset's fingerprint, and what re-rendering may vary.

    shadows: of the main lamp; two to six times the price of a picture. brightness: factor on every lamp.
    light_turn: of the lamps about the vertical through the world's origin, -180 to 180 [deg].
    Raises `UsageError` for a value out of range.
    """

    shadows: bool = option(False, "cast shadows; rendering then takes two to six times as long")
    brightness: float = option(1.0, "factor on every lamp, 0.1 to 2")
    light_turn: float = option(0.0, "turn the lamps about the vertical, -180 to 180 [deg]")

    def __post_init__(self) -> None:
        low, high = _BRIGHTNESS
        if not low <= self.brightness <= high:
            raise UsageError(f"brightness is {self.brightness}; expected a factor from {low} to {high}")
        if not -180 <= self.light_turn <= 180:
            raise UsageError(f"light_turn is {self.light_turn}; expected -180 to 180 degrees")


FILM = Look(shadows=True)  # for people: a shadow says how high a thing is


@dataclass(frozen=True)
class CameraConfig:
    """Cameras that see every step, and the height, width [pixels] and look of their pictures.

    Raises `UnknownName` for a camera, `UsageError` for none, for one named twice, and for a height or width that
    is odd (which video's 4:2:0 has not) or out of range.
    """

    names: tuple[str, ...]
    height: int = option(128, "of a picture [pixels]")
    width: int = option(128, "of a picture [pixels]")
    look: Look = field(default_factory=Look)

    def __post_init__(self) -> None:
        for name in self.names:
            if name not in CAMERAS:
                raise UnknownName("camera", name, CAMERAS)
        if not self.names or len(set(self.names)) < len(self.names):
            raise UsageError(f"cameras are {', '.join(self.names) or 'none'}; expected at least one, each once")
        if any(side % 2 or not MIN_SIDE <= side <= MAX_SIDE for side in self.size):
            raise UsageError(
                f"pictures of height {self.height} and width {self.width}; "
                f"expected even numbers from {MIN_SIDE} to {MAX_SIDE}"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Height and width."""
        return self.height, self.width
