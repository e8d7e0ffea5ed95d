"""Pictures of recorded states: another dataset with other cameras, sizes or lights, without simulating again."""

from __future__ import annotations

import dataclasses
from collections import deque
from collections.abc import Callable, Generator, Iterable, Mapping, Sequence
from concurrent.futures import BrokenExecutor, Future, ProcessPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.child_processes import bound_to_this_process, initialize_worker
from manip_il.data import schema
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.lerobot_layout import OURS
from manip_il.data.lerobot_read import (
    UNKNOWN_TASK,
    DatasetInfo,
    read_episodes,
    read_fingerprint,
    read_provenance,
    read_spec,
)
from manip_il.data.lerobot_write import new_dataset
from manip_il.data.schema import RobotTaskSpec
from manip_il.engine.environments import env_fingerprint, env_spec
from manip_il.engine.simulations import SIMULATIONS
from manip_il.errors import ManipError, MismatchError, RenderError
from manip_il.mdp import Episode, State
from manip_il.robots.robot import ROBOTS, get_robot
from manip_il.sim.conditions import NOMINAL_VALUES, PICTURED, Condition, Drawn, draw
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.variation import OLDER, with_drawn
from manip_il.tasks.table import TASKS

Pictures = dict[str, NDArray[Any]]  # columns of pictures, and of what is where in them
_DECIDE = ("model_sha256", "mujoco")  # entries of a fingerprint that pictures of a state depend on


@dataclass(frozen=True)
class Source:
    """A dataset whose states can be pictured. env: one that they fit.

    warnings: what may make the pictures differ from the recorded world. conditions: what its episodes draw from.
    """

    root: Path
    spec: RobotTaskSpec
    env: EnvConfig
    warnings: tuple[str, ...]
    conditions: tuple[Condition, ...] = ()


def open_source(root: Path, robot: str | None = None) -> Source:
    """Read what is needed to picture a dataset's states; robot: the YAML of its robot, where that does not ship.

    Raises `ManipError` for a folder that is no dataset, or one that lacks what this project's have or does not name
    a robot and task that are known here, `MismatchError` where its states do not fit them.
    """
    spec = read_spec(root)
    if spec.task == UNKNOWN_TASK:
        raise ManipError(f"{root} does not name its task: {OURS} is missing; LeRobot's tools drop it, so render first")
    for kind, name, known in (("robot", spec.robot, ROBOTS), ("task", spec.task, TASKS)):
        if name not in known and not (kind == "robot" and robot):
            by_path = f"; a robot of your own is given by --robot.type=PATH/{name}.yaml" * (kind == "robot")
            raise ManipError(
                f"{root} is for the {kind} {name!r}, which is not known here (known: {', '.join(known)}), "
                f"so its states cannot be rendered{by_path}"
            )
    if robot and (given := get_robot(robot).name) != spec.robot:
        raise MismatchError("robot", str(root), spec.robot, "--robot.type", given)
    env = EnvConfig(robot or spec.robot, spec.task, object=spec.object)
    size = env_spec(env).sim_state_size
    lacks = size - spec.sim_state_size  # of states from before they held all draws
    if lacks not in (0, *OLDER):
        raise MismatchError("size of sim_state", str(root), spec.sim_state_size, "this program", size)
    here, there = env_fingerprint(env), read_fingerprint(root)
    left, right = ({key: one.get(key, "nothing") for key in _DECIDE} for one in (there, here))
    differences = tuple(compare_fingerprints(str(root), left, "this machine", right))
    conditions = recorded_conditions(root, read_provenance(root)) if lacks == max(OLDER) else ()
    return Source(root, spec, env, differences, conditions)


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


def render_dataset(
    source: Source,
    target: Path,
    cameras: CameraConfig,
    *,
    repo_id: str,
    workers: int = 1,
    replace: bool = False,
    on_episode: Callable[[Episode], None] | None = None,
) -> DatasetInfo:
    """Write `source` anew with these cameras' pictures in place of its own; every other column stays as it is.

    replace: what `target` holds stays until the new dataset is whole, and goes then. on_episode: sees each episode once
    it is written. Raises `RenderError` where there is no OpenGL, and what reading and `new_dataset` raise.
    """
    look = env_fingerprint(source.env, cameras)["cameras_sha256"]
    names = env_spec(source.env, cameras).keypoints
    spec = dataclasses.replace(source.spec, cameras=cameras.names, image_size=cameras.size, keypoints=names)
    fingerprint = {**read_fingerprint(source.root), "cameras_sha256": look}
    rendered = {"from": source.root.name, "cameras": dataclasses.asdict(cameras)}
    states = read_episodes(source.root, pictures=False)
    with (
        new_dataset(target, spec, repo_id=repo_id, fingerprint=fingerprint, replace=replace) as writer,
        closing(render_episodes(states, source.env, cameras, workers, source.conditions)) as episodes,
    ):
        for episode in episodes:
            writer.add(episode)
            if on_episode is not None:
                on_episode(episode)
        return writer.finish({**read_provenance(source.root), "rendered": rendered})


def render_episodes(
    episodes: Iterable[Episode],
    env: EnvConfig,
    cameras: CameraConfig,
    workers: int = 1,
    conditions: Sequence[Condition] = (),
) -> Generator[Episode]:
    """Yield the episodes, in order, with pictures of their states; at most `workers` + 1 of them wait in memory.

    conditions: what they drew from by their seeds.
    Raises `RenderError` where there is no OpenGL, `ManipError` where a worker dies.
    """
    render = partial(render_states, env, cameras)
    if workers == 1:
        for episode in episodes:
            yield _with_pictures(episode, render(episode.columns[schema.SIM_STATE], draw(conditions, episode.seed)))
        return
    pool = ProcessPoolExecutor(workers, mp_context=get_context("spawn"), initializer=initialize_worker)
    waiting: deque[tuple[Episode, Future[Pictures]]] = deque()
    try:
        for episode in episodes:
            with bound_to_this_process():  # it starts processes as they are needed
                drawn = draw(conditions, episode.seed)
                waiting.append((episode, pool.submit(render, episode.columns[schema.SIM_STATE], drawn)))
            if len(waiting) > workers:
                yield _next(waiting)
        while waiting:
            yield _next(waiting)
    except BrokenExecutor as error:
        raise ManipError("a rendering worker died (out of memory?); fewer --workers need less") from error
    finally:
        pool.shutdown(cancel_futures=True)


def render_states(
    env: EnvConfig, cameras: CameraConfig, states: NDArray[Any], drawn: Drawn = NOMINAL_VALUES
) -> Pictures:
    """Return columns of states, rows of `sim_state` (T, m): pictures (T, height, width, 3), and keypoints (T, 3 K).

    drawn: what their episode draws, for states that were recorded before they held it. An environment with these
    cameras gives the same bytes in these states.
    """
    if env.robot in SIMULATIONS:
        raise RenderError(f"{env.robot} has no cameras here")
    view = ManipEnv.of(env, cameras)
    looks = {name: drawn.values[name] for name in PICTURED if name in drawn.values}
    spec, rows = env_spec(env, cameras), len(states)
    found: Pictures = {key: np.empty((rows, *cameras.size, 3), np.uint8) for key in spec.image_keys}
    found |= {key: np.empty((rows, 3 * len(spec.keypoints)), np.float32) for key in spec.keypoint_keys}
    for row, state in enumerate(states):
        view.set_state(State.from_vector(state))
        view.world.vary(with_drawn(view.world.variation, looks))
        seen = view.observe()
        for name in cameras.names:
            found[schema.IMAGES + name][row] = seen.images[name]
            found[schema.KEYPOINTS + name][row] = seen.keypoints[name].ravel()
    return found


def _with_pictures(episode: Episode, pictures: Pictures) -> Episode:
    return dataclasses.replace(episode, columns={**episode.columns, **pictures})


def _next(waiting: deque[tuple[Episode, Future[Pictures]]]) -> Episode:
    episode, pictures = waiting.popleft()
    return _with_pictures(episode, pictures.result())
