"""Make a new dataset from the stored states of another, with new labels, pictures or scenes.

The edits `relabel`, `render` and `redraw` process the source in pieces, in local processes, and
write a dataset that appears when it is complete.

New scenes from visited states: randomise goals, untouched objects and appearance, then label and
render.

The expert is a function of the state, so it can label scenes that were never visited.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import closing
from dataclasses import asdict, dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.caching import PerThread
from manip_il.collect.query import branch
from manip_il.collect.workers import map_in_order
from manip_il.data import schema
from manip_il.data.build import dataset_sha256
from manip_il.data.dataset import UNKNOWN_TASK, Dataset, EpisodeData, Own
from manip_il.data.episodes import to_episode
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.info import Info
from manip_il.data.lerobot_layout import OURS, TASK_INDEX, Features
from manip_il.data.lerobot_write import write_dataset, write_episodes
from manip_il.errors import ManipError, MismatchError, NothingToLearnError, warn
from manip_il.mdp import F64, I64, Actor, Episode, Label, Observation, State, Transition
from manip_il.option import NameOrPath
from manip_il.seeding import rng_for, stream_seeds
from manip_il.sim.conditions import Condition, draw
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import (
    env_fingerprint,
    env_spec,
    make_env,
    make_expert,
    stored_config,
)

CHUNK = 25  # scenes that one worker draws at a time
_TRIES = 5  # scenes drawn for a state before the visited scene itself is used


@dataclass(frozen=True)
class Scenes:
    """How scenes are drawn from a dataset's states.

    Attributes:
        cameras: Cameras that render the scenes; None for scenes without pictures.
        frames: Number of scenes to draw.
        seed: Seed of the random stream.
        anew: Whether to also randomise goals and objects, and not only the appearance.
        conditions: Ranges of the appearance and of the observations' noise.
        branch_steps: Control steps that the expert drives from every state, for policies that
            predict chunks.
        first: Number of the first scene in the random stream, so that datasets redrawn with the
            same seed can differ.
    """

    cameras: CameraConfig | None
    frames: int
    seed: int = 0
    anew: bool = True
    conditions: tuple[Condition, ...] = ()
    branch_steps: int = 1
    first: int = 0

    @property
    def numbers(self) -> range:
        """Numbers of the scenes in the random stream.

        Raises `UsageError` if the stream has too few.
        """
        return stream_seeds("redraw", self.first + self.frames, self.seed)[self.first :]

    def chunks(self, states: F64, leads: F64, tasks: I64) -> Iterator[tuple[int, F64, F64]]:
        """Yield the visited states from which scenes are drawn, in pieces of `CHUNK` scenes.

        Args:
            states: Rows of `sim_state`, (S, m). They are used in an order drawn from the seed, and
                repeatedly if there are more scenes than states.
            leads: Offset added to the label of each state's scene, (S, n).
            tasks: Number of each state's task, (S,). Scenes of one task follow each other, as what
                draws another takes a while to prepare.

        Yields:
            The number of the first scene, the visited states (C, m), and the offsets (C, n).
        """
        order = rng_for(self.seed, "order of redrawn states").permutation(len(states))
        chosen = order[np.arange(self.frames) % len(states)]
        chosen = chosen[np.argsort(tasks[chosen], kind="stable")]
        for at in range(0, self.frames, CHUNK):
            rows = chosen[at : at + CHUNK]
            yield self.numbers[at], states[rows], leads[rows]


class SceneDrawer:
    """Draws, labels and renders scenes of one environment.

    Args:
        config: The environment.
        scenes: How the scenes are drawn.
    """

    def __init__(self, config: EnvConfig, scenes: Scenes):
        noise = [one.only("sensing") for one in scenes.conditions]
        self._env = make_env(config, scenes.cameras, noise)
        self._has_noise = any(one.ranges for one in noise)
        self._expert = make_expert(config)
        self._scenes = scenes

    def frames(
        self, visited: State, number: int, seed: int, lead: F64 | float = 0.0
    ) -> list[Transition]:
        """Draw a new scene from a visited state, and return its labelled frames.

        If none of the drawn scenes has a valid label, or without `Scenes.anew`, the visited scene
        itself is labelled, in the drawn appearance.

        Args:
            visited: The state that is changed into the scene.
            number: Number of the scene in the random stream.
            seed: Value of the `seed` column.
            lead: Offset added to the label if the scene has a single frame, (n,).

        Returns:
            One labelled frame, or the frames of a branch; [] if there is no valid label.
        """
        rng = rng_for(number, "redraw")
        if self._has_noise:
            self._env.start(number)  # draws the noise of the scene's observations
        visited = replace(visited, streak=0, ever=False)
        if drawn := draw([one.only("look") for one in self._scenes.conditions], number):
            visited = self._env.varied(visited, drawn)
        for _ in range(_TRIES if self._scenes.anew else 0):
            state = self._env.redrawn(visited, rng)
            if state is not None and (label := self._expert.label(state)).valid:
                break
        else:
            state, label = visited, self._expert.label(visited)
        if not label.valid:
            return []
        if self._scenes.branch_steps == 1:
            return [self._frame(state, replace(label, action=label.action + lead), seed)]
        return list(branch(self._env, self._expert, state, seed, self._scenes.branch_steps))

    def _frame(self, state: State, label: Label, seed: int) -> Transition:
        env, action = self._env, label.action
        env.set_state(state)
        return Transition(
            seed,
            state.step,
            state,
            env.observe(),
            label,
            action,
            Actor.EXPERT,
            0.0,
            False,
            True,
            env.progress,
        )


Columns = dict[str, NDArray[Any]]
_COMPARED = ("model_sha256", "mujoco")  # entries of a fingerprint that affect restored states
SERVED = "lerobot"  # `driver` of datasets recorded by LeRobot's programs from our servos


@dataclass(frozen=True)
class EditSource:
    """A dataset whose states can be restored, and their environment.

    Attributes:
        dataset: The dataset.
        env: Settings of its environment.
    """

    dataset: Dataset
    env: EnvConfig

    def check_has_no_sag(self, what: str) -> None:
        """Raise `ManipError` if the labels hold the sag of `serve`'s servos.

        Args:
            what: The edit that would drop the sag, for the message.
        """
        if _is_served(self.dataset.provenance):
            raise ManipError(
                f"the labels in {self.dataset.root} hold the sag of serve's servos; {what} would"
                " drop it"
            )


def open_source(
    root: Path,
    robot: NameOrPath | None = None,
    task: NameOrPath | None = None,
    shape: NameOrPath | None = None,
) -> EditSource:
    """Open a dataset whose states are to be restored.

    Warn if the compiled model or MuJoCo's version differs.

    Args:
        root: The dataset's folder.
        robot: The robot as in `EnvConfig`, if it is the user's own; by default the one that the
            dataset names.
        task: The same for the task.
        shape: The same for the object, if it is a mesh of the user's own.

    Returns:
        The dataset and its environment.

    Raises:
        ManipError: if the folder is not a dataset of ours.
        MismatchError: if the dataset is for another robot, task or object, or its states have
            another size.
        UsageError: as in `stored_config`, for a robot, a task or an object that is not built in.
        Unable: if the environment's states cannot be restored.
    """
    dataset = Dataset.open(root)
    spec = dataset.spec
    if spec.task == UNKNOWN_TASK:
        raise ManipError(
            f"{root} has no {OURS}, which LeRobot's tools drop: copy it from the dataset that this"
            " one was made from"
        )
    env = stored_config(spec, robot, task, shape)
    given = env_spec(env)
    given.require("restored", "record again what you need")
    for what in ("robot", "task", "object", "sim_state_size"):
        if getattr(given, what) != getattr(spec, what):
            raise MismatchError(
                what, str(root), getattr(spec, what), f"the given {what}", getattr(given, what)
            )
    here, there = env_fingerprint(env), dataset.fingerprint
    left, right = ({key: one.get(key, "nothing") for key in _COMPARED} for one in (there, here))
    warn(*compare_fingerprints(str(root), left, "this machine", right))
    return EditSource(dataset, env)


@dataclass(frozen=True)
class EditTarget:
    """The new dataset's folder, and how it is written.

    Attributes:
        root: The new folder.
        workers: Number of processes; with 1 this process does the work.
        replace: Whether to replace a dataset of ours at `root`.
        on_piece: Called after each episode, or each `CHUNK` of scenes.
    """

    root: Path
    workers: int = 1
    replace: bool = False
    on_piece: Callable[[], None] = lambda: None


def relabel_dataset(source: EditSource, target: EditTarget) -> Info:
    """Write `source` with the current expert's label of every state.

    States in which the expert was not queried get a label, too. All other columns and the pictures
    stay the same.

    Args:
        source: The dataset to relabel.
        target: The new dataset's folder, and how it is written.

    Returns:
        The new dataset's `info.json`.

    Raises:
        ManipError: if the labels hold the sag of `serve`'s servos, or if a worker dies; also what
            `Dataset.stored_episodes` and `write_episodes` raise.
    """
    source.check_has_no_sag("data relabel")
    dataset = source.dataset
    simulated = {
        key: value for key, value in dataset.fingerprint.items() if key.endswith("_sha256")
    }
    fingerprint = {**env_fingerprint(source.env), **simulated}
    own = Own(dataset.spec, fingerprint, {**dataset.provenance, "relabelled": _origin(source)})
    work = partial(label_states, source.env)
    return rewrite(source, target, work, own, dataset.stored_features)


def render_dataset(source: EditSource, cameras: CameraConfig, target: EditTarget) -> Info:
    """Write `source` with the pictures of these cameras instead of its own.

    All other columns stay the same.

    Args:
        source: The dataset to render.
        cameras: Cameras, and the size and look of their pictures.
        target: The new dataset's folder, and how it is written.

    Returns:
        The new dataset's `info.json`.

    Raises:
        RenderError: if there is no OpenGL.
        Unable: if the environment cannot be drawn.
        UnknownName: for a camera that the environment does not have.
        ManipError: as in `Dataset.stored_episodes` and `write_episodes`.
    """
    dataset, here = source.dataset, env_spec(source.env, cameras)
    spec = replace(
        dataset.spec, cameras=here.cameras, image_size=here.image_size, keypoints=here.keypoints
    )
    look = env_fingerprint(source.env, cameras)["cameras_sha256"]
    rendered = {"from": dataset.root.name, "cameras": asdict(cameras)}
    own = Own(
        spec,
        {**dataset.fingerprint, "cameras_sha256": look},
        {**dataset.provenance, "rendered": rendered},
    )
    ours = schema.features(dataset.spec)
    others = {key: one for key, one in dataset.stored_features.items() if key not in ours}
    work = partial(render_states, source.env, cameras)
    return rewrite(source, target, work, own, schema.features(spec) | others)


def redraw_dataset(source: EditSource, scenes: Scenes, target: EditTarget) -> Info:
    """Write a dataset of new scenes made from the states of `source`.

    Each frame or branch is an episode. The same seed gives the same scenes, and a larger number of
    frames only adds scenes, at the end if there is one task.

    Args:
        source: The dataset whose states are changed into scenes.
        scenes: How the scenes are drawn.
        target: The new dataset's folder, and how it is written.

    Returns:
        The new dataset's `info.json`.

    Raises:
        NothingToLearnError: if no scene has a valid label.
        ManipError: if branches are asked for, but the labels hold the sag of `serve`'s servos.
        Unable: if the environment cannot be redrawn, varied or drawn as `scenes` asks.
    """
    if scenes.branch_steps > 1:
        source.check_has_no_sag("--branch_steps")
    spec = env_spec(source.env, scenes.cameras)
    if scenes.anew:
        spec.require("redrawn", "give --scenes=false")
    if scenes.conditions:
        spec.require("varied", "leave out --vary")
    columns = source.dataset.columns(
        [schema.SIM_STATE, schema.ACTION, schema.LABEL_VALID, TASK_INDEX]
    )
    drawn = {
        "scenes": scenes.anew,
        "branch_steps": scenes.branch_steps,
        "cameras": scenes.cameras and asdict(scenes.cameras),
    }
    vary = (
        {"vary": [condition.to_json() for condition in scenes.conditions]}
        if scenes.conditions
        else {}
    )
    seeds = scenes.numbers[::CHUNK]
    tried = {"seeds": [seeds[0], seeds[-1]], "tried": len(seeds)}
    provenance = {"redrawn": {**_origin(source), **drawn, **vary}, **tried}
    spec = replace(spec, video=False)  # frames are independent scenes
    fingerprint = env_fingerprint(source.env, scenes.cameras)
    pieces = scenes.chunks(
        columns[schema.SIM_STATE], _leads(source, columns), columns[TASK_INDEX].reshape(-1)
    )

    def episodes() -> Iterator[Episode]:
        empty = True
        for _, found in made:
            yield from found
            empty = empty and not found
            target.on_piece()
        if empty:
            raise NothingToLearnError(
                "no scene has a valid expert label, so there is nothing to learn from"
            )

    with closing(
        map_in_order(partial(_draw_scenes, source.env, scenes), pieces, target.workers)
    ) as made:
        return write_dataset(
            episodes(),
            target.root,
            spec,
            provenance,
            replace=target.replace,
            fingerprint=fingerprint,
        )


def rewrite(
    source: EditSource,
    target: EditTarget,
    work: Callable[[Any], Mapping[str, Any]],
    own: Own,
    features: Features,
    read: Iterable[Any] = (),
) -> Info:
    """Write `source` with the columns that workers make from each episode.

    Args:
        source: The dataset to edit.
        target: The new dataset's folder, and how it is written.
        work: Makes the columns, (T, ...).
        own: What `meta/manip_il.json` says of the new dataset.
        features: Of the new dataset.
        read: What `work` gets of each episode; by default its states, (T, m).

    Returns:
        The new dataset's `info.json`.
    """
    dataset = source.dataset

    def episodes() -> Iterator[EpisodeData]:
        for one, (_, found) in zip(dataset.stored_episodes(), made, strict=True):
            target.on_piece()
            yield replace(one, columns={**one.columns, **found})

    states = (
        np.asarray(one.columns[schema.SIM_STATE])
        for one in dataset.stored_episodes([schema.SIM_STATE])
    )
    about = dataset.fps, dataset.info.robot, own
    with closing(map_in_order(work, read or states, target.workers)) as made:
        return write_episodes(
            episodes(),
            target.root,
            features,
            *about,
            tables=dataset.other_tables,
            replace=target.replace,
        )


def label_states(env: EnvConfig, states: NDArray[Any]) -> Columns:
    """Return the expert's labels of states, rows of `sim_state` (T, m), as columns of a dataset,
    (T,) or (T, n).

    If a label is invalid, its action holds the arm still and `label_valid` is 0.
    """
    labels = _labels(env, states)
    return {
        schema.ACTION: np.stack([label.action for label in labels]).astype(np.float32),
        schema.LABEL_VALID: np.array([label.valid for label in labels], np.int64),
        schema.EXPERT_PHASE: np.array([label.phase for label in labels], np.int64),
    }


def _labels(env: EnvConfig, states: NDArray[Any]) -> list[Label]:
    expert = make_expert(env)
    return [expert.label(State.from_vector(state)) for state in states]


def render_states(env: EnvConfig, cameras: CameraConfig, states: NDArray[Any]) -> Columns:
    """Render the pictures and keypoints of states.

    The values are bit-equal to what an environment with these cameras observes.

    Args:
        env: The environment of the states.
        cameras: Cameras, and the size and look of their pictures.
        states: Rows of `sim_state`, (T, m).

    Returns:
        Columns of a dataset: pictures (T, height, width, 3), and keypoints (T, 3 K).

    Raises:
        RenderError: if there is no OpenGL.
    """
    view = make_env(env, cameras)
    spec = env_spec(env, cameras)
    seen: list[Observation] = []
    for state in states:
        view.set_state(State.from_vector(state))
        seen.append(view.observe())
    found: Columns = {
        schema.IMAGES + name: np.stack([one.images[name] for one in seen]) for name in cameras.names
    }
    for key, name in spec.keypoint_keys.items():
        points = np.stack([one.keypoints[name].ravel() for one in seen])
        found[key] = points.astype(np.float32)
    return found


def _leads(source: EditSource, columns: Columns) -> F64:
    """Return recorded minus expert labels, (T, n): the servos' sag, if `serve --log=` wrote the
    dataset; else 0.
    """
    action = columns[schema.ACTION].astype(np.float64)
    if not _is_served(source.dataset.provenance):
        return np.zeros_like(action)
    own = np.stack([label.action for label in _labels(source.env, columns[schema.SIM_STATE])])
    return np.where(columns[schema.LABEL_VALID].reshape(-1, 1) > 0, action - own, 0.0)


def _is_served(provenance: Mapping[str, Any]) -> bool:
    """Whether our servos recorded a dataset, or one of those merged into it."""
    merged = provenance.get("merged", ())
    return provenance.get("driver") == SERVED or any(
        _is_served(one["provenance"]) for one in merged
    )


def _draw_scenes(env: EnvConfig, scenes: Scenes, chunk: tuple[int, F64, F64]) -> list[Episode]:
    seed, states, leads = chunk
    drawer = _drawer(env, scenes)
    rows = enumerate(zip(states, leads, strict=True))
    made = (
        drawer.frames(State.from_vector(state), seed + at, seed, lead) for at, (state, lead) in rows
    )
    return [to_episode(frames) for frames in made if frames]


def _origin(source: EditSource) -> dict[str, str]:
    return {"from": source.dataset.root.name, "sha256": dataset_sha256(source.dataset.root)}


_drawer = PerThread(SceneDrawer, 1)
