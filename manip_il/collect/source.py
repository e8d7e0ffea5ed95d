"""Datasets whose states can be restored here: to picture them, to label them, to draw other scenes of them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.lerobot_layout import OURS
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError, MismatchError
from manip_il.robots.robot import ROBOTS, get_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import EnvConfig
from manip_il.sim.variation import OLDER
from manip_il.stock.table import ROBOT as STOCK_ROBOT
from manip_il.stock.table import STOCK
from manip_il.tasks.table import TASKS

_DECIDE = ("model_sha256", "mujoco")  # entries of a fingerprint that what is made of a state depends on


@dataclass(frozen=True)
class Source:
    """A dataset whose states can be restored. env: one that they fit.

    warnings: what may make the restored world differ from the recorded one. conditions: what its episodes draw from.
    """

    dataset: Dataset
    spec: RobotTaskSpec
    env: EnvConfig
    warnings: tuple[str, ...]
    conditions: tuple[Condition, ...] = ()

    @property
    def root(self) -> Path:
        """Folder of the dataset."""
        return self.dataset.root


def open_source(root: Path, robot: str | None = None) -> Source:
    """Read what is needed to restore a dataset's states; robot: the YAML of its robot, where that does not ship.

    Raises `ManipError` for a folder that is no dataset, or one that lacks what this project's have or does not name
    a robot and task that are known here, `MismatchError` where its states do not fit them.
    """
    dataset = Dataset.open(root)
    spec = dataset.spec
    if spec.task == UNKNOWN_TASK:
        raise ManipError(
            f"{root} does not name its task: {OURS} is missing; LeRobot's tools drop it: render or relabel first"
        )
    tasks = STOCK if spec.robot == STOCK_ROBOT else TASKS
    for kind, name, known in (("robot", spec.robot, [*ROBOTS, STOCK_ROBOT]), ("task", spec.task, tasks)):
        if name not in known and not (kind == "robot" and robot):
            by_path = f"; a robot of your own is given by --robot.type=PATH/{name}.yaml" * (kind == "robot")
            raise ManipError(
                f"{root} is for the {kind} {name!r}, which is not known here (known: {', '.join(known)}), "
                f"so its states cannot be restored{by_path}"
            )
    if robot and (given := get_robot(robot).name) != spec.robot:
        raise MismatchError("robot", str(root), spec.robot, "--robot.type", given)
    env = EnvConfig(robot or spec.robot, spec.task, object=spec.object)
    size = env_spec(env).sim_state_size
    lacks = size - spec.sim_state_size  # of states from before they held all draws
    if lacks not in (0, *OLDER):
        raise MismatchError("size of sim_state", str(root), spec.sim_state_size, "this program", size)
    here, there = env_fingerprint(env), dataset.fingerprint
    left, right = ({key: one.get(key, "nothing") for key in _DECIDE} for one in (there, here))
    differences = tuple(compare_fingerprints(str(root), left, "this machine", right))
    conditions = recorded_conditions(root, dataset.provenance) if lacks == max(OLDER) else ()
    return Source(dataset, spec, env, differences, conditions)


def recorded_conditions(root: Path, provenance: Mapping[str, Any]) -> tuple[Condition, ...]:
    """Return what the episodes of a dataset drew from, by its provenance; none where their worlds were nominal.

    Raises `ManipError` for a merged one whose parts differ in that.
    """
    parts = [checks.mapping(f"{root}: a part", part) for part in provenance.get("merged", [])]
    if parts:
        found = {recorded_conditions(root, checks.mapping(f"{root}: a part", part["provenance"])) for part in parts}
        if len(found) > 1:
            raise ManipError(f"{root} was merged from datasets that vary in different ways; render those, then merge")
        return found.pop()
    trees = [dict(checks.mapping(f"{root}: vary", tree)) for tree in provenance.get("vary", [])]
    return tuple(Condition.from_mapping(tree.pop("name"), tree) for tree in trees)
