"""Names of worlds, and the settings of an environment by the names of robot and task."""

from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from manip_il.option import NameOrPath, option
from manip_il.robots import ROBOTS
from manip_il.sim.config import Episodes
from manip_il.sim.shape import SHAPE_HELP
from manip_il.tasks import NAMES, SEVERAL


class Listed(NamedTuple):
    """What help says of a world, and the module whose `WORLD` makes it."""

    module: str
    about: str
    tasks: tuple[str, ...]  # some of them, if there are `others`
    cameras: tuple[str, ...] = ()
    others: str = ""


WORLD_GROUP = "manip_il.worlds"  # entry points: a world's name, and its `GymWorld`
WORLDS: dict[NameOrPath, Listed] = {
    "fetch_stock": Listed(
        "manip_il.worlds.fetch.environment",
        "gymnasium-robotics' Fetch",
        ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4"),
    ),
    "aloha": Listed(
        "manip_il.worlds.aloha.environment",
        "gym_aloha's two arms",
        ("AlohaTransferCube-v0", "AlohaInsertion-v0"),
        ("top", "angle", "front_close", "left_pillar", "right_pillar", "left_wrist", "right_wrist"),
    ),
    "metaworld": Listed(
        "manip_il.worlds.metaworld",
        "Meta-World's Sawyer",
        ("push-v3", "peg-insert-side-v3"),
        ("corner2",),
        others="48 others, easy, medium, hard, very_hard",
    ),
}


def _listed(world: Listed) -> str:
    return ", ".join((*world.tasks, *([world.others] if world.others else [])))


ROBOT_HELP = (
    f"{', '.join(ROBOTS)}, the path of your own arm's YAML or your own world's Python file, or,"
    " unmodified, "
    f"{', '.join(f'{name} ({world.about})' for name, world in WORLDS.items())}"
)
TASK_HELP = (
    f"{', '.join((*NAMES, *SEVERAL))}, several of these with commas between them, or the path of"
    " your own task's Python file; "
    f"{'; '.join(f'with {name}, ' + _listed(world) for name, world in WORLDS.items())}"
)


@dataclass(frozen=True)
class EnvConfig(Episodes):
    """Settings of one environment; every field is part of the fingerprint.

    A name that was stored is a `str`, which no code takes for a path.

    Attributes:
        robot: A name, or the `Path` of a user's own file.
        task: The same for the task.
        object: Shape and size of what is grasped, as `ObjectShape.parse` reads it, or the `Path` of
            a mesh; empty for the task's default.
    """

    robot: NameOrPath = option("panda", ROBOT_HELP, flag="robot.type", alias="env.type")
    task: NameOrPath = option("pick_place", TASK_HELP, flag="task.type", alias="env.task")
    object: NameOrPath = option("", f"{SHAPE_HELP}; by default the task's own", flag="task.object")

    @property
    def name(self) -> str:
        """Robot and task joined by "_": a file by its name without the suffix, a task without
        its argument.
        """
        task = Path(self.task).stem.partition(":")[0].replace(",", "-")
        return f"{Path(self.robot).stem}_{task}"
