"""Turn transitions into episodes with a dataset's columns, and rollouts into the episodes that a dataset takes.

One rollout is one `Episode`: the learner's path, and what the expert did from where it took over or demonstrated a
branch. Each of these parts ends with `next.done`; in a dataset each is an episode (`parts`).
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.journal import Header
from manip_il.errors import MismatchError, NothingToLearnError
from manip_il.mdp import Episode, Transition

_LOG = logging.getLogger(__name__)


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
    """Return an episode with the schema's columns, (T, 1) or (T, d).

    labelled: with the columns of labels; in frames without one `label_valid` is 0, the phase 0, and the label the
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
        success_at_end=decides[-1].success,
        instruction=frames[0].observation.instruction,
    )


def parts(episode: Episode) -> list[Episode]:
    """Cut a rollout behind every frame that is `next.done`: each part is an episode of a dataset."""
    ends = np.flatnonzero(episode.columns[schema.DONE].ravel()) + 1
    if len(ends) < 2:
        return [episode]
    starts = [0, *ends[:-1].tolist()]
    return [_part(episode, slice(*rows)) for rows in zip(starts, ends.tolist(), strict=True)]


def count_labels(episode: Episode) -> int:
    """Return the number of an episode's valid labels."""
    return int(episode.columns[schema.LABEL_VALID].sum()) if schema.LABEL_VALID in episode.columns else 0


def first_labels(episode: Episode, most: int) -> Episode:
    """Return the episode with `label_valid` 0 behind its first `most` sound labels."""
    valid = episode.columns[schema.LABEL_VALID].astype(np.int64)
    kept = valid * (np.cumsum(valid).reshape(valid.shape) <= most)
    return replace(episode, columns=episode.columns | {schema.LABEL_VALID: kept})


class Selection:
    """The episodes that a dataset takes of rollouts in seed order, by the rules of a `Recording`.

    It depends on the rollouts alone, so that recording as they come and building later give the same dataset.
    """

    def __init__(self, only_successes: bool, only_labelled: bool, episodes: int | None, labels: int | None):
        self._only_successes, self._only_labelled = only_successes, only_labelled
        self._most_episodes, self._most_labels = episodes, labels
        self._first: Header | None = None
        self._seeds: list[int] = []  # of the rollouts until it was full
        self._episodes = self._labels = 0
        self.failed = 0  # episodes left out as they failed

    @property
    def is_full(self) -> bool:
        """Whether every asked episode or label is in."""
        episodes, labels = self._most_episodes, self._most_labels
        return (episodes is not None and self._episodes >= episodes) or (labels is not None and self._labels >= labels)

    @property
    def provenance(self) -> dict[str, Any]:
        """First and last seed of the rollouts that were taken from, and their number."""
        return {"seeds": [self._seeds[0], self._seeds[-1]], "tried": len(self._seeds)}

    def take(self, rollouts: Iterable[tuple[Header, Episode]]) -> Iterator[Episode]:
        """Yield the episodes to write; every rollout is read, also once it is full.

        Raises `MismatchError` for a rollout of another robot, task or cameras than the first, and at the end
        `NothingToLearnError` where there was no episode. Other fingerprints than the first's are logged as warnings.
        """
        for header, rollout in rollouts:
            self._check_source(header)
            if self.is_full:
                continue
            self._seeds.append(header.seed)
            for part in parts(rollout):
                if not self.is_full:
                    yield from self._take_part(part)
        if not self._episodes:
            raise NothingToLearnError(
                "no episode has labels to learn from: the expert was never queried, or gave no valid label"
            )

    def _check_source(self, header: Header) -> None:
        first = self._first = self._first or header
        name = f"the journal of seed {header.seed}"
        if header.spec != first.spec:
            raise MismatchError("robot, task or cameras", name, header.spec, "the first", first.spec)
        for line in compare_fingerprints(name, header.fingerprint, "the first", first.fingerprint):
            _LOG.warning("%s", line)

    def _take_part(self, part: Episode) -> Iterator[Episode]:
        if self._only_successes and not part.success:
            self.failed += 1
            return
        if self._most_labels is not None:
            part = first_labels(part, self._most_labels - self._labels)
        labels = count_labels(part)
        if self._only_labelled and not labels:
            return
        yield part
        self._episodes += 1
        self._labels += labels


def _part(episode: Episode, rows: slice) -> Episode:
    columns = {key: column[rows] for key, column in episode.columns.items()}
    solved = columns[schema.SUCCESS]
    ends = {"success": bool(solved.any()), "success_at_end": bool(solved[-1].any())}
    return replace(episode, columns=columns, **ends)


def _column(values: list[Any], dtype: type) -> NDArray[Any]:
    return np.asarray(values, dtype=dtype)[:, None]
