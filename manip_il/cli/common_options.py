"""Options that several commands share."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from manip_il.errors import UsageError
from manip_il.option import option, option_of
from manip_il.robots import ROBOTS
from manip_il.sim.config import ROBOT_HELP, TASK_HELP, CameraConfig, EnvConfig, Look
from manip_il.sim.shape import SHAPE_HELP
from manip_il.stock import table as stock
from manip_il.tasks.reward import Reward

if TYPE_CHECKING:
    from manip_il.learn.checkpoint import Origin

SMALL_SIDE = 96  # of a picture that a policy learns from [pixels]
_TRUST = (
    "load models, and run code, that a checkpoint names (smolvla, pi0, groot, ...): only for sources that you trust; "
    "only on the command line"
)

_CONDITIONS = "object, dynamics, knocked, sensing, random_actions; with cameras view, clutter, late"
VARY_HELP = f"how worlds differ from episode to episode: {_CONDITIONS}, or YAMLs of ranges"
SUITE_HELP = f"nominal, disturbed, randomised, all; one condition of {_CONDITIONS}; or a YAML of ranges"


def seed_option() -> Any:
    """Return the field of `--seed`."""
    return option(0, "shifts every random stream, 0 to 1000")


def engine_option() -> Any:
    """Return the field of `--engine`."""
    return option("local", "where episodes run: local processes, or a Ray cluster (RAY_ADDRESS, or one started here)")


def workers_option() -> Any:
    """Return the field of `--workers`."""
    return option(None, "processes, or tasks at once on Ray; by default one per core")


def trust_option() -> Any:
    """Return the field of `--trust`, which only the command line may set."""
    return option(False, _TRUST, command_line_only=True)


def require_pictures(robot: str, cameras: Sequence[str]) -> None:
    """Raise `UsageError` for cameras of a robot whose environments have none."""
    if cameras and robot == stock.ROBOT:
        raise UsageError(f"--cameras is {','.join(cameras)}; {robot} has no cameras here, leave it out")


def own_robot(robot: str, suffix: str = "") -> str:
    """Return the option, after a space, that a next command needs for a robot that does not ship; else nothing."""
    return "" if robot in (*ROBOTS, stock.ROBOT) else f" --robot.type={robot}{suffix}"


def require_workers(workers: int | None) -> None:
    """Raise `UsageError` for less than one process."""
    if workers is not None and workers < 1:
        raise UsageError(f"--workers is {workers}; expected at least 1")


def _reward(text: str) -> str:
    """Return a reward as its numbers: a file that it came from may change."""
    return Reward.parse(text).numbers if text else ""


@dataclass
class RobotGroup:
    """`--robot.*`."""

    type: str = option_of(EnvConfig, "robot")


@dataclass
class TaskGroup:
    """`--task.*`."""

    type: str = option_of(EnvConfig, "task")
    object: str = option_of(EnvConfig, "object")
    reward: str = option_of(EnvConfig, "reward")

    def __post_init__(self) -> None:
        self.reward = _reward(self.reward)


@dataclass
class MaybeRobotGroup:
    """`--robot.*` where a checkpoint may say it."""

    type: str | None = option(None, f"{ROBOT_HELP}; by default the policy's, else {EnvConfig.robot}")


@dataclass
class MaybeTaskGroup:
    """`--task.*` where a checkpoint may say it."""

    type: str | None = option(None, f"{TASK_HELP}; by default the policy's, else {EnvConfig.task}")
    object: str | None = option(None, f"{SHAPE_HELP}; by default the policy's, else the task's own")
    reward: str = option_of(EnvConfig, "reward")

    def __post_init__(self) -> None:
        self.reward = _reward(self.reward)


@dataclass
class TrialGroup:
    """`--eval.*` of policies that are compared."""

    n_episodes: int = option(500, "test episodes, the same for both sides")


@dataclass
class EnvGroup:
    """`--env.*`: what makes an environment beside robot and task."""

    tolerance: float = option_of(EnvConfig, "tolerance")
    horizon: int = option_of(EnvConfig, "horizon")
    control_hz: int | None = option(
        None, "control steps a second; by default the policy's, else the robot's own, 30 of so101, 20 of others"
    )
    success_steps: int = option_of(EnvConfig, "success_steps")

    def config(
        self,
        robot: str | None,
        task: str | None,
        meta: Origin | None = None,
        shape: str | None = None,
        reward: str = "",
    ) -> EnvConfig:
        """Return the environment; `UnknownName` for a robot or task, `UsageError` for a value.

        robot, task, shape (of its object): None for those of the policy. meta: what a policy says of itself, where
        there is one. reward: of `carry`, empty for the task's own.
        """
        from manip_il.data.dataset import UNKNOWN_TASK
        from manip_il.robots.table import get_robot
        from manip_il.sim.scene import build_scene
        from manip_il.tasks.table import get_task

        robot = robot or (meta.robot if meta else EnvConfig.robot)
        task = task or (meta.task if meta and meta.task != UNKNOWN_TASK else EnvConfig.task)
        if shape is None:
            shape = meta.object if meta and meta.task == task else ""
        is_stock = robot == stock.ROBOT
        if not is_stock:
            if task in stock.STOCK:
                raise UsageError(f"--task.type={task} is with --robot.type={robot}; expected {stock.ROBOT}")
            get_robot(robot)
            get_task(task)
        hz = (meta.fps if meta else 0) if self.control_hz is None else self.control_hz
        env = EnvConfig(robot, task, hz, self.tolerance, self.success_steps, self.horizon, shape, reward)
        if env.object:
            build_scene(robot, task, env.object)  # which finds an object that is too wide
        return env


@dataclass
class EnvOptions:
    """First options of a command that names robot and task itself."""

    robot: RobotGroup = field(default_factory=RobotGroup)
    task: TaskGroup = field(default_factory=TaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)

    def env_config(self) -> EnvConfig:
        """Return the environment, see `EnvGroup.config`."""
        return self.env.config(self.robot.type, self.task.type, shape=self.task.object, reward=self.task.reward)


@dataclass
class ImageGroup:
    """`--image.*`: the pictures of every camera."""

    height: int = option_of(CameraConfig, "height")
    width: int = option_of(CameraConfig, "width")

    def config(self, cameras: Sequence[str], look: Look | None = None) -> CameraConfig | None:
        """Return the cameras, None for none; `UnknownName` for a camera, `UsageError` for a size."""
        return CameraConfig(tuple(cameras), self.height, self.width, look or Look()) if cameras else None


@dataclass
class SmallImageGroup(ImageGroup):
    """`--image.*`: the pictures of every camera, as small as a policy learns from them."""

    height: int = option(SMALL_SIDE, "of a picture [pixels]")
    width: int = option(SMALL_SIDE, "of a picture [pixels]")


def policy_help(words: Iterable[str]) -> str:
    """Return the options of the policy that `--policy.type=` in a command's words names; nothing where none does."""
    kind = next((word.partition("=")[2] for word in words if word.startswith("--policy.type=")), "")
    if not kind:
        return ""
    from manip_il.learn.lerobot_config import option_lines

    rows = option_lines(kind)
    width = max(len(left) for left, _ in rows) + 2
    lines = "\n".join(f"  {left:{width}}[{right}]" for left, right in rows)
    return f"\n\noptions of {kind}:\n{lines}"
