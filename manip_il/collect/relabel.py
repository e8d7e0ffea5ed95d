"""Labels of recorded states by the expert of today: another dataset, without simulating or rendering again."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import dataclass
from functools import lru_cache, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.child_processes import map_in_order
from manip_il.collect.environments import env_actions, env_fingerprint, make_expert
from manip_il.collect.rollout import Labeller
from manip_il.collect.source import Source
from manip_il.data import schema
from manip_il.data.build import dataset_sha256, rewrite_columns
from manip_il.mdp import Episode, State
from manip_il.sim.config import EnvConfig

Columns = dict[str, NDArray[Any]]
NOTICEABLE = 0.01  # of a joint's longest step, or of the gripper's whole opening: a label that differs by less is none


@dataclass
class Changes:
    """Counts of what relabelling changed. actions: of labels sound before and after, by more than `NOTICEABLE`."""

    episodes: int = 0
    frames: int = 0
    actions: int = 0
    phases: int = 0
    gained: int = 0  # frames that had no sound label and have one now
    lost: int = 0

    def add(self, before: Columns, after: Columns, scale: NDArray[np.float64]) -> None:
        """Count an episode's. scale: of an action's entries, (n,)."""
        was, now = (one[schema.LABEL_VALID].ravel().astype(bool) for one in (before, after))
        gaps = np.abs(before[schema.ACTION] - after[schema.ACTION]) / scale
        phases = before[schema.EXPERT_PHASE].ravel() != after[schema.EXPERT_PHASE].ravel()
        self.episodes += 1
        self.frames += len(was)
        self.actions += int((was & now & (gaps.max(axis=1) > NOTICEABLE)).sum())
        self.phases += int((was & now & phases).sum())
        self.gained += int((now & ~was).sum())
        self.lost += int((was & ~now).sum())


def relabel_dataset(
    source: Source,
    target: Path,
    *,
    repo_id: str,
    workers: int = 1,
    replace: bool = False,
    on_episode: Callable[[Episode], None] | None = None,
) -> Changes:
    """Write `source` anew with the expert's label of every state; executed actions, pictures and all else stay.

    A state that the expert was not asked in when it was recorded is labelled, too. replace: as in `new_folder`.
    Raises what reading and `rewrite_columns` raise, `ManipError` where a worker dies.
    """
    changes, scale = Changes(), env_actions(source.env).scale

    def relabelled() -> Iterator[Columns]:
        for episode, columns in found:
            changes.add(episode.columns, columns, scale)
            if on_episode is not None:
                on_episode(episode)
            yield columns

    origin = {"from": source.root.name, "sha256": dataset_sha256(source.root)}
    simulated = {key: value for key, value in source.dataset.fingerprint.items() if key.endswith("_sha256")}
    fingerprint = {**env_fingerprint(source.env), **simulated}
    provenance = {**source.dataset.provenance, "relabelled": origin}
    about: dict[str, Any] = {"repo_id": repo_id, "fingerprint": fingerprint, "replace": replace}
    episodes = source.dataset.read_episodes(pictures=False)
    with closing(map_in_order(partial(_label_episode, source.env), episodes, workers)) as found:
        rewrite_columns(source.dataset, target, relabelled(), provenance, **about)
    return changes


def _label_episode(env: EnvConfig, episode: Episode) -> Columns:
    return label_states(env, episode.columns[schema.SIM_STATE])


def label_states(env: EnvConfig, states: NDArray[Any]) -> Columns:
    """Return the columns of the expert's labels of states, rows of `sim_state` (T, m), as datasets have them.

    Where there is no sound label the action holds the arm still, and `label_valid` is 0.
    """
    expert = _expert(env)
    labels = [expert.label(State.from_vector(state)) for state in states]
    return {
        schema.ACTION: np.stack([label.action for label in labels]).astype(np.float32),
        schema.LABEL_VALID: np.array([label.valid for label in labels], np.int64),
        schema.EXPERT_PHASE: np.array([label.phase for label in labels], np.int64),
    }


@lru_cache(1)
def _expert(env: EnvConfig) -> Labeller:
    return make_expert(env)
