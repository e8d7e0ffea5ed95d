"""Turn transitions into rollouts with a dataset's columns, and rollouts into the episodes of a
dataset.

One rollout is one `Episode`: the learner's path, followed by the expert's takeover or branches.
Each of these parts ends with `next.done`; in a dataset each is an episode (`parts`).
"""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.mdp import Episode, Transition


def group_rollouts(transitions: Iterable[Transition]) -> Iterator[list[Transition]]:
    """Group interleaved transitions by rollout.

    Yield each group when its last transition arrives.
    """
    running: dict[int, list[Transition]] = {}
    for transition in transitions:
        frames = running.setdefault(transition.seed, [])
        frames.append(transition)
        if transition.done:
            yield running.pop(transition.seed)


def to_episode(
    frames: Sequence[Transition],
    round_: int = 0,
    beta: float = 1.0,
    *,
    labelled: bool = True,
    path: int | None = None,
) -> Episode:
    """Return an episode with the schema's columns, (T, 1) or (T, d), pictures (T, height, width,
    3).

    Args:
        frames: Of one rollout, in order.
        round_: Number of the round of DAgger.
        beta: Probability that the expert drove.
        labelled: Whether to include the columns of labels; frames without a label have
            `label_valid` 0, phase 0, and the executed action as label.
        path: Number of leading frames that decide success; by default all.
    """
    rows = [
        _row(frame, labelled=labelled) | {schema.ROUND: round_, schema.BETA: beta}
        for frame in frames
    ]
    columns: dict[str, NDArray[Any]] = {}
    for key in rows[0]:
        column = np.array([row[key] for row in rows])
        if column.dtype == np.float64 and key != schema.SIM_STATE:
            column = column.astype(np.float32)
        columns[key] = column if key.startswith(schema.IMAGES) else column.reshape(len(rows), -1)
    decides = frames[:path]
    return Episode(
        seed=frames[0].seed,
        columns=columns,
        success=any(frame.success for frame in decides),
        success_at_end=bool(decides) and decides[-1].success,
        instruction=frames[0].observation.instruction,
    )


def _row(frame: Transition, *, labelled: bool) -> dict[str, Any]:
    """Return a frame's values in the columns."""
    seen, label = frame.observation, frame.label
    row: dict[str, Any] = {
        schema.STATE: seen.state,
        schema.EXECUTED_ACTION: frame.executed_action,
        schema.ACTOR: int(frame.actor),
        schema.SIM_STATE: frame.state.to_vector(),
        schema.PROGRESS: float(frame.progress),
        schema.REWARD: float(frame.reward),
        schema.SUCCESS: bool(frame.success),
        schema.DONE: bool(frame.done),
        schema.SEED: frame.seed,
        schema.EXPERT_PHASE: label.phase if label else 0,
    }
    if seen.environment_state.size:
        row[schema.ENVIRONMENT_STATE] = seen.environment_state
    row |= {schema.IMAGES + camera: picture for camera, picture in seen.images.items()}
    row |= {schema.KEYPOINTS + camera: points for camera, points in seen.keypoints.items()}
    if labelled:
        row[schema.ACTION] = label.action if label else frame.executed_action
        row[schema.LABEL_VALID] = int(bool(label and label.valid))
    return row


def parts(episode: Episode) -> list[Episode]:
    """Split a rollout after every frame with `next.done`; each part is an episode of a dataset."""
    ends = np.flatnonzero(episode.columns[schema.DONE].ravel()) + 1
    found: list[Episode] = []
    start = 0
    for end in ends.tolist():
        columns = {key: column[start:end] for key, column in episode.columns.items()}
        solved = columns[schema.SUCCESS]
        found.append(
            replace(
                episode,
                columns=columns,
                success=bool(solved.any()),
                success_at_end=bool(solved[-1]),
            )
        )
        start = end
    return found or [episode]
