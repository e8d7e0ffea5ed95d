"""Transitions to episodes: the columns that a dataset holds.

One rollout is one episode here, whatever comes of it: the learner's path, and what the expert did from where it took
over or was asked to show the way. Each part ends with `next.done`; in a dataset each is an episode (`parts`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import schema
from manip_il.mdp import Episode, Observation, Transition

_FINAL = "final/"  # before the number of a part and a column: what was seen after its last frame


def group_rollouts(transitions: Iterable[Transition]) -> Iterator[list[Transition]]:
    """Yield each rollout's transitions as its last one arrives, from interleaved ones."""
    running: dict[int, list[Transition]] = {}
    for transition in transitions:
        frames = running.setdefault(transition.seed, [])
        frames.append(transition)
        if transition.done:
            yield running.pop(transition.seed)


def to_episode(
    frames: Sequence[Transition], round_: int = 0, beta: float = 1.0, *, labelled: bool = True, path: int | None = None
) -> Episode:
    """Return an episode with the schema's columns.

    labelled: with the columns of labels; where nobody asked, `label_valid` is 0, the phase 0, and the label the
    executed action. path: the first so many frames decide whether it succeeded; by default all.
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
    if labelled:
        columns[schema.ACTION] = np.stack([_taught(frame) for frame in frames]).astype(np.float32)
        columns[schema.LABEL_VALID] = _column([bool(frame.label and frame.label.valid) for frame in frames], np.int64)
    decides = frames[:path]
    return Episode(
        seed=frames[0].seed,
        columns=columns,
        success=any(frame.success for frame in decides),
        success_at_end=decides[-1].success,
        final=tuple(frame.final for frame in frames if frame.done and frame.final is not None),
    )


def parts(episode: Episode) -> list[Episode]:
    """What a dataset has as episodes of their own: cut behind every frame that is `next.done`."""
    ends = np.flatnonzero(episode.columns[schema.DONE].ravel()) + 1
    if len(ends) < 2:
        return [episode]
    starts = [0, *ends[:-1].tolist()]
    finals = [(one,) for one in episode.final] if len(episode.final) == len(ends) else [()] * len(ends)
    return [_part(episode, slice(*rows), final) for *rows, final in zip(starts, ends.tolist(), finals, strict=True)]


def final_columns(final: Sequence[Observation]) -> dict[str, NDArray[Any]]:
    """What was seen after each part of an episode as named arrays, the inverse of `take_final`."""
    columns: dict[str, NDArray[Any]] = {}
    for number, one in enumerate(final):
        pictures = {schema.IMAGES + camera: picture for camera, picture in one.images.items()}
        shown = {schema.STATE: one.state, schema.ENVIRONMENT_STATE: one.environment_state, **pictures}
        columns |= {f"{_FINAL}{number}/{key}": values for key, values in shown.items()}
    return columns


def take_final(columns: dict[str, NDArray[Any]]) -> tuple[Observation, ...]:
    """Remove what `final_columns` gave from `columns`, and return it as it was.

    Raises `ValueError` for numbers that are not counted from 0, or without joints or environment.
    """
    found: dict[str, dict[str, NDArray[Any]]] = {}
    for name in [name for name in columns if name.startswith(_FINAL)]:
        number, _, key = name.removeprefix(_FINAL).partition("/")
        found.setdefault(number, {})[key] = columns.pop(name)
    if sorted(found) != sorted(map(str, range(len(found)))) or any(
        {schema.STATE, schema.ENVIRONMENT_STATE} - shown.keys() for shown in found.values()
    ):
        raise ValueError(f"it holds last observations {checks.shorten(sorted(found))}; expected them whole, from 0 on")
    return tuple(_final(found[str(number)]) for number in range(len(found)))


def _final(shown: dict[str, NDArray[Any]]) -> Observation:
    pictures = {key.removeprefix(schema.IMAGES): one for key, one in shown.items() if key.startswith(schema.IMAGES)}
    return Observation(shown[schema.STATE], shown[schema.ENVIRONMENT_STATE], pictures)


def count_labels(episode: Episode) -> int:
    """Return its sound labels."""
    return int(episode.columns[schema.LABEL_VALID].sum()) if schema.LABEL_VALID in episode.columns else 0


def first_labels(episode: Episode, most: int) -> Episode:
    """Return the episode with `label_valid` 0 behind its first `most` sound labels."""
    valid = episode.columns[schema.LABEL_VALID].astype(np.int64)
    kept = valid * (np.cumsum(valid).reshape(valid.shape) <= most)
    return replace(episode, columns=episode.columns | {schema.LABEL_VALID: kept})


def _part(episode: Episode, rows: slice, final: tuple[Observation, ...]) -> Episode:
    columns = {key: column[rows] for key, column in episode.columns.items()}
    solved = columns[schema.SUCCESS]
    return Episode(episode.seed, columns, bool(solved.any()), bool(solved[-1].any()), final)


def _taught(frame: Transition) -> NDArray[np.float64]:
    return frame.executed_action if frame.label is None else frame.label.action


def _column(values: list[Any], dtype: type) -> NDArray[Any]:
    return np.asarray(values, dtype=dtype)[:, None]
