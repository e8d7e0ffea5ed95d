"""Turn transitions into episodes with a dataset's columns, and rollouts into the episodes that a dataset takes.

One rollout is one `Episode`: the learner's path, and what the expert did from where it took over or demonstrated a
branch. Each of these parts ends with `next.done`; in a dataset each is an episode (`parts`).
"""

from __future__ import annotations

import json
import logging
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import schema
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import MismatchError, NothingToLearnError
from manip_il.mdp import Episode, Observation, Transition

_FINAL = "final/"  # before the number of a part and a column: the observation after its last frame
_LOG = logging.getLogger(__name__)
_NEEDED = ("seed", "success", "success_at_end", "frames", "spec", "fingerprint")  # of a header
_OPTIONAL = {"instruction": '""', "drawn": "{}"}


@dataclass(frozen=True)
class Header:
    """An episode without its columns: how it ended, what it drew, and the environment that it comes from."""

    seed: int
    success: bool
    success_at_end: bool
    frames: int
    spec: RobotTaskSpec
    fingerprint: dict[str, Any]
    instruction: str = ""  # of the episode, where it is not that of the spec
    drawn: Mapping[str, Any] = field(default_factory=dict)

    @classmethod
    def of(cls, episode: Episode, spec: RobotTaskSpec, fingerprint: dict[str, Any]) -> Header:
        """Return the header of an episode."""
        ends = bool(episode.success), bool(episode.success_at_end)
        return cls(episode.seed, *ends, len(episode), spec, fingerprint, episode.instruction, episode.drawn)

    def to_texts(self) -> dict[str, str]:
        """Return it as JSON by name, as a journal has it."""
        values = {name: getattr(self, name) for name in _NEEDED} | {"spec": self.spec.to_json()}
        optional = {"instruction": self.instruction} | ({"drawn": dict(self.drawn)} if self.drawn else {})
        return {name: json.dumps(value) for name, value in (values | optional).items()}

    @classmethod
    def from_texts(cls, data: Mapping[str, str]) -> Header:
        """Return the inverse of `to_texts`; journals of older versions have neither instruction nor draws.

        Raises `ValueError` or `ManipError` for anything else.
        """
        if missing := [key for key in _NEEDED if key not in data]:
            raise ValueError(f"its header lacks {', '.join(missing)}")
        given = {key: data[key] for key in _NEEDED} | {key: data.get(key, plain) for key, plain in _OPTIONAL.items()}
        values = {key: checks.parse_json(f"its {key}", text) for key, text in given.items()}
        return cls(
            checks.whole("its seed", values["seed"], 0, checks.LARGEST_SEED),
            checks.truth("its success", values["success"]),
            checks.truth("its success_at_end", values["success_at_end"]),
            checks.whole("its number of frames", values["frames"], 1, schema.MOST_FRAMES),
            RobotTaskSpec.from_json(values["spec"]),
            checks.mapping("its fingerprint", values["fingerprint"]),
            checks.text("its instruction", values["instruction"]),
            checks.mapping("what it drew", values["drawn"]),
        )


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
        final=tuple(frame.final for frame in frames if frame.done and frame.final is not None),
        instruction=frames[0].observation.instruction,
    )


def parts(episode: Episode) -> list[Episode]:
    """Cut a rollout behind every frame that is `next.done`: each part is an episode of a dataset."""
    ends = np.flatnonzero(episode.columns[schema.DONE].ravel()) + 1
    if len(ends) < 2:
        return [episode]
    starts = [0, *ends[:-1].tolist()]
    finals = [(one,) for one in episode.final] if len(episode.final) == len(ends) else [()] * len(ends)
    return [_part(episode, slice(*rows), final) for *rows, final in zip(starts, ends.tolist(), finals, strict=True)]


def final_columns(final: Sequence[Observation]) -> dict[str, NDArray[Any]]:
    """Return the observations after each part of an episode as named arrays, (n,), (k,) and (height, width, 3).

    The inverse of `take_final`.
    """
    columns: dict[str, NDArray[Any]] = {}
    for number, one in enumerate(final):
        pictures = {schema.IMAGES + camera: picture for camera, picture in one.images.items()}
        arrays = {schema.STATE: one.state, schema.ENVIRONMENT_STATE: one.environment_state, **pictures}
        columns |= {f"{_FINAL}{number}/{key}": values for key, values in arrays.items()}
    return columns


def take_final(columns: dict[str, NDArray[Any]]) -> tuple[Observation, ...]:
    """Remove from `columns` the arrays (n,), (k,), ... that `final_columns` gave, and return their observations.

    Raises `ValueError` for numbers that are not counted from 0, or without joints or environment.
    """
    found: dict[str, dict[str, NDArray[Any]]] = {}
    for name in [name for name in columns if name.startswith(_FINAL)]:
        number, _, key = name.removeprefix(_FINAL).partition("/")
        found.setdefault(number, {})[key] = columns.pop(name)
    if sorted(found) != sorted(map(str, range(len(found)))) or any(
        {schema.STATE, schema.ENVIRONMENT_STATE} - arrays.keys() for arrays in found.values()
    ):
        raise ValueError(f"it holds last observations {checks.shorten(sorted(found))}; expected them whole, from 0 on")
    return tuple(_final(found[str(number)]) for number in range(len(found)))


def _final(arrays: dict[str, NDArray[Any]]) -> Observation:
    pictures = {key.removeprefix(schema.IMAGES): one for key, one in arrays.items() if key.startswith(schema.IMAGES)}
    return Observation(arrays[schema.STATE], arrays[schema.ENVIRONMENT_STATE], pictures)


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


def _part(episode: Episode, rows: slice, final: tuple[Observation, ...]) -> Episode:
    columns = {key: column[rows] for key, column in episode.columns.items()}
    solved = columns[schema.SUCCESS]
    ends = {"success": bool(solved.any()), "success_at_end": bool(solved[-1].any())}
    return replace(episode, columns=columns, final=final, **ends)


def _column(values: list[Any], dtype: type) -> NDArray[Any]:
    return np.asarray(values, dtype=dtype)[:, None]
