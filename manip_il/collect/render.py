"""Pictures of recorded states: another dataset with other cameras, sizes or lights, without simulating again."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Generator, Iterable, Sequence
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.child_processes import map_in_order
from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.source import Source
from manip_il.data import schema
from manip_il.data.info import DatasetInfo
from manip_il.data.lerobot_write import new_dataset
from manip_il.errors import RenderError
from manip_il.mdp import Episode, State
from manip_il.sim.conditions import NOMINAL_VALUES, PICTURED, Condition, Drawn, draw
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import EnvConfig, ManipEnv
from manip_il.sim.variation import with_drawn
from manip_il.stock.table import ROBOT as STOCK

Pictures = dict[str, NDArray[Any]]  # columns of pictures, and of what is where in them


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
    fingerprint = {**source.dataset.fingerprint, "cameras_sha256": look}
    rendered = {"from": source.root.name, "cameras": dataclasses.asdict(cameras)}
    states = (one.without_pictures() for one in source.dataset.read_episodes(pictures=False))
    with (
        new_dataset(target, spec, repo_id=repo_id, fingerprint=fingerprint, replace=replace) as writer,
        closing(render_episodes(states, source.env, cameras, workers, source.conditions)) as episodes,
    ):
        for episode in episodes:
            writer.add(episode)
            if on_episode is not None:
                on_episode(episode)
        return writer.finish({**source.dataset.provenance, "rendered": rendered})


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
    drawn = ((episode, draw(conditions, episode.seed)) for episode in episodes)
    found = map_in_order(partial(_pictures_of, env, cameras), drawn, workers)
    with closing(found):
        for (episode, _), pictures in found:
            yield dataclasses.replace(episode, columns={**episode.columns, **pictures})


def _pictures_of(env: EnvConfig, cameras: CameraConfig, drawn: tuple[Episode, Drawn]) -> Pictures:
    episode, values = drawn
    return render_states(env, cameras, episode.columns[schema.SIM_STATE], values)


def render_states(
    env: EnvConfig, cameras: CameraConfig, states: NDArray[Any], drawn: Drawn = NOMINAL_VALUES
) -> Pictures:
    """Return columns of states, rows of `sim_state` (T, m): pictures (T, height, width, 3), and keypoints (T, 3 K).

    drawn: what their episode draws, for states that were recorded before they held it. An environment with these
    cameras gives the same bytes in these states.
    """
    if env.robot == STOCK:
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
