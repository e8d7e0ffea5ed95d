"""What an arm of one's own can do before anything is recorded: joints, gripper, reach, the expert at every task."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.errors import UsageError
from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.results import EvalResult, write_json
from manip_il.evaluation.runner import HOLD, evaluate
from manip_il.evaluation.suites import read_condition
from manip_il.robots.reach import reach_of
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import NOMINAL
from manip_il.sim.config import EnvConfig
from manip_il.sim.home import Pair, meeting_at
from manip_il.sim.scene import PREFIX, build_scene
from manip_il.sim.variation import widest_grasp
from manip_il.sim.world import Scene, World
from manip_il.tasks.table import get_task
from manip_il.tasks.task import Task

F64 = NDArray[np.float64]
FILE_NAME = "check.json"
SOLVES = 0.9  # share of clean episodes that the expert solves, of a task that can be done
STARTS = 50  # of each task that are drawn
ENOUGH = 0.95  # share of a workspace that a robot reaches, of one that suits it
LOW = 0.03  # height of what lies on the table [m]
_PLAIN = "reach"  # the task of the scene in which the arm itself is looked at
_NOISE = "random_actions"  # of the suites
_SECONDS = 1.0  # of each step response
_FEW = 3  # starts without a place, after which no more are drawn
_ACROSS = 41  # points of a share along each edge of the workspace
_NARROWER = 0.01  # steps in which a smaller workspace is tried [m]


@dataclass(frozen=True)
class JointFacts:
    """One joint of the arm; of a joint that slides, m and N stand for rad and N m.

    limits: [rad], None if it turns freely. home [rad]. kp [N m/rad], kv [N m s/rad], force: the greatest [N m].
    rise: from a tenth to nine tenths of the longest step of its target [s], None if that takes over a second.
    overshoot: beyond that step, as its share.
    """

    name: str
    slides: bool
    limits: tuple[float, float] | None
    home: float
    kp: float
    kv: float
    force: float
    rise: float | None
    overshoot: float


@dataclass(frozen=True)
class TaskCheck:
    """One task with a robot.

    widths: of what is grasped [m]. refused: why there is no scene, or why a start found no place; else empty. found,
    drawn: starts. objects, goals: where on the table they are, x and y [m]; goals are those and the furniture. clean,
    noisy: evaluations of the expert, as it is and with a tenth of its actions random; None if none ran.
    """

    name: str
    widths: Mapping[str, float]
    refused: str = ""
    found: int = 0
    drawn: int = 0
    objects: tuple[tuple[float, float], ...] = ()
    goals: tuple[tuple[float, float], ...] = ()
    clean: EvalResult | None = None
    noisy: EvalResult | None = None

    @property
    def has_starts(self) -> bool:
        """Whether every start that was drawn found a place."""
        return 0 < self.found == self.drawn

    @property
    def done(self) -> bool:
        """Whether the robot can do it."""
        return self.has_starts and (self.clean is None or self.clean.success.rate >= SOLVES)

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        episodes: dict[str, Any] = {}
        for name, one in (("clean", self.clean), ("noisy", self.noisy)):
            episodes[name] = one and {
                "successes": one.success.successes,
                "n": one.success.n,
                "interval": one.success.interval,
                "failures": one.failures,
            }
        starts = {"found": self.found, "drawn": self.drawn} if self.drawn else None
        facts = {"widths": dict(self.widths), "refused": self.refused, "starts": starts}
        return {"task": self.name, "done": self.done} | facts | episodes


@dataclass(frozen=True)
class RobotCheck:
    """A robot as it was measured. name: as it was given.

    opening: the widest of the gripper [m]. overlaps: pairs of links at home, and in any posture. table: share of points
    on the table of the workspace that the hand, pointing down, gets to. half_width: the widest at which a share of
    `ENOUGH` of the table is reached [m]; 0 if there is none.
    """

    name: str
    robot: Robot
    joints: tuple[JointFacts, ...]
    opening: float
    overlaps: tuple[Pair, ...]
    table: float
    half_width: float
    tasks: tuple[TaskCheck, ...]

    @property
    def failed(self) -> tuple[TaskCheck, ...]:
        """Tasks that cannot be done."""
        return tuple(task for task in self.tasks if not task.done)

    def write(self, path: Path) -> None:
        """Write all figures as JSON."""
        facts = {
            "robot": self.name,
            "hand": self.robot.hand,
            "joints": [dataclasses.asdict(joint) for joint in self.joints],
            "gripper": {"joints": self.robot.gripper.joints, "opening": self.opening},
            "home_overlaps": self.overlaps,
            "reach": {name: getattr(self, name) for name in ("table", "half_width")},
            "tasks": [task.to_json() for task in self.tasks],
        }
        write_json(path, facts, indent=2)


def check_robot(
    name: str, tasks: Sequence[str], episodes: int, engine: Engine, on_result: Callable[[EpisodeResult], object]
) -> RobotCheck:
    """Measure a robot, by its name or YAML, with tasks. episodes: of each task, clean and as many with random actions.

    on_result: called with every episode's result as it ends. Raises `UsageError` if the robot itself cannot be used.
    """
    robot, scene = get_robot(name), build_scene(name, _PLAIN)
    overlaps = tuple(meeting_at(robot, scene.model, PREFIX, np.asarray(robot.home)))
    checked = [check_starts(name, task) for task in tasks]
    if episodes:
        checked = [_with_episodes(name, task, episodes, engine, on_result) for task in checked]
    return RobotCheck(
        name, robot, arm_facts(scene), scene.gripper.most, overlaps, *reach_facts(robot), tasks=tuple(checked)
    )


def check_starts(name: str, task: str) -> TaskCheck:
    """Draw a task's starts with a robot as episodes do; stops after a few that find no place."""
    the_task = get_task(task)
    checked = TaskCheck(task, widths(the_task))
    try:
        scene = build_scene(name, task)
    except UsageError as error:
        return dataclasses.replace(checked, refused=str(error))
    world = World(scene)
    world.update()
    objects, goals, why, found, drawn = list[tuple[float, float]](), list[tuple[float, float]](), "", 0, 0
    for seed in stream_seeds("validation", STARTS):
        if drawn - found == _FEW:
            break
        drawn += 1
        try:
            poses = the_task.draw(rng_for(seed, "reset"), world).poses
        except UsageError as error:
            why = str(error)
            continue
        found += 1
        for thing, (at, _) in poses.items():
            (objects if thing in scene.objects else goals).append((float(at[0]), float(at[1])))
    places = {"objects": tuple(objects), "goals": tuple(goals)}
    return dataclasses.replace(checked, refused=why, found=found, drawn=drawn, **places)


def widths(task: Task) -> dict[str, float]:
    """Return how wide the objects that a task grasps are between fingers from above, by name [m]."""
    spec = mujoco.MjSpec()
    task.build(spec)
    model, found = spec.compile(), dict[str, float]()
    for name in task.grasped:
        geom = int(model.body(name).geomadr[0])
        found[name] = widest_grasp(int(model.geom_type[geom]), model.geom_size[geom])
    return found


def reach_facts(robot: Robot) -> tuple[float, float]:
    """Return `table` and `half_width` of a `RobotCheck`; takes seconds if the map is not kept yet."""
    reach, ((x, y), half_width) = reach_of(robot), (robot.workspace.centre, robot.workspace.half_width)

    def share(half: float) -> float:
        steps = np.linspace(-half, half, _ACROSS).tolist()
        return float(np.mean([reach.has((x + dx, y + dy, LOW)) for dx in steps for dy in steps]))

    narrower = np.arange(half_width, 0.0, -_NARROWER).tolist()
    return share(half_width), round(next((half for half in narrower if share(half) >= ENOUGH), 0.0), 3)


def reach_map(robot: Robot, room: float, cells: int = 60) -> tuple[F64, tuple[float, float, float, float]]:
    """Return where the hand, pointing down, gets to on the table, 1 or 0, (y, x), and the map's extent [m].

    room: around the workspace [m]. The extent is left, right, bottom, top.
    """
    reach, (x, y), half = reach_of(robot), robot.workspace.centre, robot.workspace.half_width + room
    offsets = ((np.arange(cells) + 0.5) / cells * 2 - 1) * half
    reached = [[float(reach.has((x + dx, y + dy, LOW))) for dx in offsets] for dy in offsets]
    return np.array(reached), (x - half, x + half, y - half, y + half)


def arm_facts(scene: Scene) -> tuple[JointFacts, ...]:
    """Return what every joint of a scene's arm does alone, from home, the gripper open."""
    return tuple(_joint(scene, place) for place in range(len(scene.robot.joints)))


def at_home(scene: Scene) -> mujoco.MjData:
    """Return the physics of a scene with the arm at home and the gripper open, commanded to stay so."""
    data, gripper = mujoco.MjData(scene.model), scene.gripper
    data.qpos[scene.arm_q] = data.ctrl[scene.arm_ctrl] = scene.robot.home
    data.qpos[gripper.q] = data.ctrl[gripper.ctrl] = gripper.command(gripper.most)
    mujoco.mj_forward(scene.model, data)
    return data


def _joint(scene: Scene, place: int) -> JointFacts:
    robot, model = scene.robot, scene.model
    joint, motor = model.joint(PREFIX + robot.joints[place]), int(scene.arm_ctrl[place])
    limits = (float(joint.range[0]), float(joint.range[1])) if joint.limited[0] else None
    home = robot.home[place]
    upwards = limits is None or limits[1] - home >= home - limits[0]
    gone = _step_response(scene, place, robot.max_joint_step if upwards else -robot.max_joint_step)
    rise = float(np.argmax(gone >= 0.9) - np.argmax(gone >= 0.1)) * model.opt.timestep if gone.max() >= 0.9 else None
    return JointFacts(
        name=robot.joints[place],
        slides=int(joint.type[0]) == mujoco.mjtJoint.mjJNT_SLIDE,
        limits=limits,
        home=home,
        kp=float(model.actuator_gainprm[motor, 0]),
        kv=-float(model.actuator_biasprm[motor, 2]),
        force=float(model.actuator_forcerange[motor, 1]),
        rise=rise,
        overshoot=max(0.0, float(gone.max()) - 1.0),
    )


def _step_response(scene: Scene, place: int, step: float) -> F64:
    """The share of a step of one joint's target that is gone at each physics step, (t,)."""
    data = at_home(scene)
    begin = data.qpos[scene.arm_q[place]]
    data.ctrl[scene.arm_ctrl[place]] = begin + step
    gone = np.empty(round(_SECONDS / scene.model.opt.timestep))
    for moment in range(len(gone)):
        mujoco.mj_step(scene.model, data)
        gone[moment] = (data.qpos[scene.arm_q[place]] - begin) / step
    return gone


def _with_episodes(
    name: str, task: TaskCheck, episodes: int, engine: Engine, on_result: Callable[[EpisodeResult], object]
) -> TaskCheck:
    if not task.has_starts:
        return task
    env, seeds, found = EnvConfig(name, task.name), stream_seeds("validation", episodes), list[EvalResult]()
    for condition in (NOMINAL, read_condition(_NOISE)):
        job = RolloutJob(env, hold=HOLD, label="last", conditions=(condition,))
        found.append(evaluate(engine, job, seeds, "expert", on_result, suite=condition.name))
    return dataclasses.replace(task, clean=found[0], noisy=found[1])
