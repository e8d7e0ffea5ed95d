"""Turn transitions into rollouts with a dataset's columns, and rollouts into the episodes of a dataset.

One rollout is one `Episode`: the learner's path, followed by the expert's takeover or branches. Each of these parts
ends with `next.done`; in a dataset each is an episode (`parts`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.mdp import Episode, Transition


def group_rollouts(transitions: Iterable[Transition]) -> Iterator[list[Transition]]:
    """Group interleaved transitions by rollout; yield each group when its last transition arrives."""
    running: dict[int, list[Transition]] = {}
    for transition in transitions:
        frames = running.setdefault(transition.seed, [])
        frames.append(transition)
        if transition.done:
            yield running.pop(transition.seed)


def to_episode(
    frames: Sequence[Transition], round_: int = 0, beta: float = 1.0, *, labelled: bool = True, path: int | None = None
) -> Episode:
    """Return an episode with the schema's columns, (T, 1) or (T, d).

    labelled: include the columns of labels; frames without a label have `label_valid` 0, phase 0, and the executed
    action as label. path: number of leading frames that decide success; by default all.
    """
    count = len(frames)
    columns: dict[str, NDArray[Any]] = {
        schema.STATE: np.stack([frame.observation.state for frame in frames]),
        schema.ENVIRONMENT_STATE: np.stack([frame.observation.environment_state for frame in frames]),
        schema.EXECUTED_ACTION: np.stack([frame.executed_action for frame in frames]).astype(np.float32),
        schema.ACTOR: _column([frame.actor for frame in frames], np.int64),
        schema.SIM_STATE: np.stack([frame.state.to_vector() for frame in frames]),
        schema.PROGRESS: _column([frame.progress for frame in frames], np.float32),
        schema.REWARD: _column([frame.reward for frame in frames], np.float32),
        schema.SUCCESS: _column([frame.success for frame in frames], np.bool_),
        schema.DONE: _column([frame.done for frame in frames], np.bool_),
        schema.SEED: _column([frame.seed for frame in frames], np.int64),
        schema.ROUND: _column([round_] * count, np.int64),
        schema.BETA: _column([beta] * count, np.float32),
        schema.EXPERT_PHASE: _column([frame.label.phase if frame.label else 0 for frame in frames], np.int64),
    }
    for camera in frames[0].observation.images:
        columns[schema.IMAGES + camera] = np.stack([frame.observation.images[camera] for frame in frames])
    for camera in frames[0].observation.keypoints:
        places = np.stack([frame.observation.keypoints[camera] for frame in frames])
        columns[schema.KEYPOINTS + camera] = places.reshape(count, -1)
    if labelled:
        columns[schema.ACTION] = np.stack(
            [frame.label.action if frame.label else frame.executed_action for frame in frames]
        ).astype(np.float32)
        columns[schema.LABEL_VALID] = _column([bool(frame.label and frame.label.valid) for frame in frames], np.int64)
    decides = frames[:path]
    return Episode(
        seed=frames[0].seed,
        columns=columns,
        success=any(frame.success for frame in decides),
        success_at_end=bool(decides) and decides[-1].success,
        instruction=frames[0].observation.instruction,
    )


def parts(episode: Episode) -> list[Episode]:
    """Split a rollout after every frame with `next.done`; each part is an episode of a dataset."""
    ends = np.flatnonzero(episode.columns[schema.DONE].ravel()) + 1
    if not len(ends):
        return [episode]
    found: list[Episode] = []
    for start, end in zip([0, *ends[:-1].tolist()], ends.tolist(), strict=True):
        columns = {key: column[start:end] for key, column in episode.columns.items()}
        solved = columns[schema.SUCCESS]
        found.append(replace(episode, columns=columns, success=bool(solved.any()), success_at_end=bool(solved[-1])))
    return found


def _column(values: list[Any], dtype: type) -> NDArray[Any]:
    return np.asarray(values, dtype=dtype)[:, None]
