"""Transitions to episodes: the columns that a dataset holds."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.mdp import Episode, Phase, Transition


def group_episodes(transitions: Iterable[Transition], round_: int = 0, beta: float = 1.0) -> Iterator[Episode]:
    """Yield each episode as its last transition arrives, from interleaved ones."""
    open_episodes: dict[int, list[Transition]] = {}
    for transition in transitions:
        frames = open_episodes.setdefault(transition.seed, [])
        frames.append(transition)
        if transition.done:
            yield to_episode(open_episodes.pop(transition.seed), round_, beta)


def to_episode(frames: list[Transition], round_: int, beta: float) -> Episode:
    """An episode with the schema's columns; those of the expert are left out where it was not asked throughout."""
    count = len(frames)
    columns: dict[str, NDArray[Any]] = {
        schema.STATE: np.stack([frame.observation.state for frame in frames]),
        schema.ENVIRONMENT_STATE: np.stack([frame.observation.environment_state for frame in frames]),
        schema.EXECUTED_ACTION: np.stack([frame.executed_action for frame in frames]).astype(np.float32),
        schema.ACTOR: _column([frame.actor for frame in frames], np.int64),
        schema.SIM_STATE: np.stack([frame.state.to_vector() for frame in frames]),
        schema.REWARD: _column([frame.reward for frame in frames], np.float32),
        schema.SUCCESS: _column([frame.success for frame in frames], np.bool_),
        schema.DONE: _column([frame.done for frame in frames], np.bool_),
        schema.SEED: _column([frame.seed for frame in frames], np.int64),
        schema.ROUND: _column([round_] * count, np.int64),
        schema.BETA: _column([beta] * count, np.float32),
        schema.EXPERT_PHASE: _column([frame.label.phase if frame.label else Phase.NONE for frame in frames], np.int64),
    }
    for camera in frames[0].observation.images:
        columns[schema.IMAGES + camera] = np.stack([frame.observation.images[camera] for frame in frames])
    labels = [frame.label for frame in frames if frame.label is not None]
    if len(labels) == count:
        columns[schema.ACTION] = np.stack([label.action for label in labels]).astype(np.float32)
        columns[schema.LABEL_VALID] = _column([label.valid for label in labels], np.int64)
    return Episode(
        seed=frames[0].seed,
        columns=columns,
        success=any(frame.success for frame in frames),
        success_at_end=frames[-1].success,
    )


def _column(values: list[Any], dtype: type) -> NDArray[Any]:
    return np.asarray(values, dtype=dtype)[:, None]
