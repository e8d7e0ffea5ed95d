"""Pairs of clips to compare, and answers about them.

Pairs are stored as `pairs.json`, answers as `preferences.json`, by people or by simulated teachers.
Teachers compare clips by true progress (B-Pref, Lee et al. 2021, section 3):

    P(left is better) = sigmoid(beta (G(left) - G(right)))
    G(clip) = sum over its steps of progress

The return G sums true progress over the clip's steps; B-Pref sums the task's reward. Progress is a
property of the state, so a clip is better if it is closer to success or gets there faster.
"""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.special import expit

from manip_il import checks
from manip_il.data import schema
from manip_il.data.build import dataset_sha256
from manip_il.data.dataset import Dataset, joined_columns
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.checkpoint import in_one_line
from manip_il.learn.samples import check_same_sources
from manip_il.mdp import F32, F64, I64, require_finite
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.fingerprint import canonical_json

_TRIES = 100  # attempts to draw a new pair
FORMAT, VERSION = "manip_il pairs", 1
_ROUNDS = "round_*/dataset"  # a run's datasets
PREFERENCES = "manip_il preferences"  # format of an answers file
BETTER = {"left": 1.0, "right": 0.0, "equal": 0.5}  # probability that the left clip is better
_ROUNDING = 1e-9  # returns that differ by less than this are equal


@dataclass(frozen=True, eq=False)
class Frames:
    """The frames of one or more datasets.

    Attributes:
        spec: The environment.
        inputs: Inputs of a reward, (N, n + k + n): state, environment state and the action as
            executed.
        episodes: Episode number of each frame, ascending, (N,).
        progress: True progress at each frame, (N,).
        success: Whether the task is solved at each frame, (N,).
    """

    spec: EnvironmentSpec
    inputs: F32
    episodes: I64
    progress: F64
    success: NDArray[np.bool_]

    @cached_property
    def firsts(self) -> I64:
        """Row of each episode's first frame, (E,)."""
        return np.flatnonzero(np.diff(self.episodes, prepend=-1))

    @cached_property
    def lengths(self) -> I64:
        """Number of frames of each episode, (E,)."""
        return np.diff(self.firsts, append=len(self.inputs))


def read_frames(*sources: Dataset | Path) -> Frames:
    """Return the frames of one or more datasets, whose episodes are numbered consecutively.

    Raises `MismatchError` unless they have the same task and columns, and `ManipError` if one lacks
    our columns or has non-finite numbers.
    """
    datasets = [one if isinstance(one, Dataset) else Dataset.open(one) for one in sources]
    roots, specs = [one.root for one in datasets], [one.spec for one in datasets]
    check_same_sources(dict(zip(roots, specs, strict=True)), pictures=False, language=False)
    given = (schema.STATE, schema.ENVIRONMENT_STATE, schema.EXECUTED_ACTION)
    table = joined_columns(datasets, [*given, schema.PROGRESS, schema.SUCCESS, EPISODE_INDEX])
    for name, values in table.items():
        require_finite(f"{', '.join(map(str, roots))}, column {name}", values)
    return Frames(
        specs[0],
        np.concatenate([table[name] for name in given], axis=1, dtype=np.float32),
        table[EPISODE_INDEX].astype(np.int64).ravel(),
        table[schema.PROGRESS].astype(np.float64).ravel(),
        table[schema.SUCCESS].astype(bool).ravel(),
    )


def find_datasets(folders: Sequence[Path]) -> list[Path]:
    """Return the datasets in folders: for a run the datasets of all its rounds, otherwise the
    folder itself.
    """
    found: list[Path] = []
    for folder in folders:
        found += sorted(folder.glob(_ROUNDS)) or [folder]
    return found


@dataclass(frozen=True)
class Source:
    """A dataset.

    Attributes:
        root: Its folder when the pairs were chosen, for messages alone.
        sha256: Its hash, see `dataset_sha256`.
        episodes: Number of its episodes.
        frames: Number of its frames.
    """

    root: str
    sha256: str
    episodes: int
    frames: int


class Clip(NamedTuple):
    """The start of a clip.

    Attributes:
        source: Index of the source.
        episode: Index of an episode in the source.
        first: Index of the clip's first frame in the episode.
    """

    source: int
    episode: int
    first: int


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Pairs of clips, left and right, of equal length, from datasets of one task.

    Attributes:
        format: What the file is.
        version: Version of its format.
        robot: Name of the robot.
        task: Name of the task.
        control_hz: Control steps per second.
        clip: Length of every clip [control steps]. If lengths differed, the reward's constant
            offset, which comparisons do not determine, would count more often for the longer clip.
        seed: Seed that the pairs were drawn with.
        chosen: How the pairs were chosen, in words.
        sources: The datasets.
        pairs: The left and the right clip of each pair.
    """

    format: str = FORMAT
    version: int = VERSION
    robot: str
    task: str
    control_hz: float
    clip: int
    seed: int = 0
    chosen: str = "evenly"
    sources: tuple[Source, ...]
    pairs: tuple[tuple[Clip, Clip], ...]

    def __len__(self) -> int:
        return len(self.pairs)

    @cached_property
    def sha256(self) -> str:
        """Hash of the content; answers store it to identify their pairs."""
        return hashlib.sha256(canonical_json(self.to_json()).encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """Return the content of `pairs.json`; a clip is [source, episode, first frame]."""
        return asdict(self)

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Pairs:
        """Return the pairs that `to_json` has written."""
        made: dict[str, Any] = {
            "sources": tuple(Source(**one) for one in data["sources"]),
            "pairs": tuple((Clip(*left), Clip(*right)) for left, right in data["pairs"]),
        }
        return cls(**data | made)

    @classmethod
    def read(cls, path: Path) -> Pairs:
        """Return the pairs in a file. Raises `ManipError` for any other file."""
        return read_file(path, FORMAT, cls.from_json)


def read_file[Read](path: Path, form: str, make: Callable[[dict[str, Any]], Read]) -> Read:
    """Return what a JSON file of a format describes.

    Args:
        path: The file.
        form: Name of the format, which the file states as its `format`.
        make: Turns the file's content into the result.

    Raises:
        ManipError: If the file cannot be read, has another format or version, or has content that
            `make` rejects.
    """
    data = checks.read_json(path, form)
    with in_one_line(f"{path} holds no {form}"):
        if (data["format"], data["version"]) != (form, VERSION):
            raise ValueError(f"version {data['version']} of {data['format']}")
        return make(data)


@dataclass(frozen=True, eq=False)
class Clips:
    """Pairs together with their datasets and the frames of those.

    Attributes:
        pairs: The pairs.
        roots: Folders of the datasets, in the order of `Pairs.sources`.
        data: Frames of the datasets, in the same order.
    """

    pairs: Pairs
    roots: tuple[Path, ...]
    data: Frames

    @cached_property
    def rows(self) -> I64:
        """Rows of `data` that hold the frames of the left and right clips, (P, 2, L)."""
        episodes = np.cumsum([0, *(source.episodes for source in self.pairs.sources)])
        begin = [
            [self.data.firsts[episodes[clip.source] + clip.episode] + clip.first for clip in pair]
            for pair in self.pairs.pairs
        ]
        return np.array(begin, np.int64)[:, :, None] + np.arange(self.pairs.clip)


def read_clips(pairs: Pairs, roots: Sequence[Path]) -> Clips:
    """Return the clips of pairs.

    Args:
        pairs: The pairs. The paths stored in them are never opened: their datasets are recognised
            by their hashes.
        roots: Datasets that the user named, in any order, at least those of the pairs.

    Raises:
        ManipError: If a dataset of the pairs is missing or has changed since.
    """
    found = {dataset_sha256(root): root for root in roots}
    for source in pairs.sources:
        if source.sha256 not in found:
            raise ManipError(
                f"the pairs' dataset {source.root} is not among the sources, or has changed since"
            )
    used = tuple(found[source.sha256] for source in pairs.sources)
    return Clips(pairs, used, read_frames(*used))


def choose_pairs(
    roots: Sequence[Path], length: int, count: int, seed: int, rng: np.random.Generator
) -> Clips:
    """Choose pairs of clips from datasets, evenly. Episodes shorter than a clip are ignored.

    Args:
        roots: Folders of the datasets.
        length: Control steps of a clip.
        count: Number of pairs.
        seed: Seed that is stored with the pairs; it draws nothing itself.
        rng: Draws the pairs.

    Returns:
        The pairs with the frames of their datasets.

    Raises:
        MismatchError: If the datasets do not all have the same task and columns.
        ManipError: If there are too few different pairs of episodes as long as a clip.
    """
    datasets = [Dataset.open(root) for root in roots]
    data = read_frames(*datasets)
    spec = data.spec
    lengths = np.split(data.lengths, np.cumsum([one.info.episodes for one in datasets])[:-1])
    drawn = _draw(lengths, length, count, rng)
    if len(drawn) < count:
        raise ManipError(
            f"--count is {count}; only {len(drawn)} pairs of clips of {length} steps were found"
        )
    made = Pairs(
        robot=spec.robot,
        task=spec.task,
        control_hz=spec.fps,
        clip=length,
        sources=tuple(
            Source(str(one.root), dataset_sha256(one.root), one.info.episodes, len(one))
            for one in datasets
        ),
        pairs=tuple(drawn),
        seed=seed,
    )

    return Clips(made, tuple(roots), data)


def _draw(
    lengths: Sequence[I64], length: int, count: int, rng: np.random.Generator
) -> list[tuple[Clip, Clip]]:
    """Distinct pairs of clips, given the length of each source's episodes; all sources appear
    equally often.

    Both clips may be from one source.
    """
    found = dict[frozenset[Clip], tuple[Clip, Clip]]()
    episodes = [np.flatnonzero(one >= length) for one in lengths]
    sources = [number for number, long in enumerate(episodes) if len(long)]
    if not sources:
        return []

    def draw(source: int) -> Clip:
        """A clip of a source: a uniformly drawn episode, then a uniformly drawn first frame."""
        episode = int(rng.choice(episodes[source]))
        last = int(lengths[source][episode]) - length
        return Clip(source, episode, int(rng.integers(0, last + 1)))

    for left, right in rng.permutation(np.resize(sources, 2 * count)).reshape(count, 2).tolist():
        for _ in range(_TRIES):
            pair = draw(left), draw(right)
            if (both := frozenset(pair)) not in found and len(both) == 2:
                found[both] = pair
                break
    return list(found.values())


@dataclass(frozen=True)
class Answer:
    """An answer about a pair.

    Attributes:
        pair: Number of the pair.
        answer: `left`, `right`, `equal` or `skip`.
        when: Time in ISO 8601; None if a simulated teacher answered.
    """

    pair: int
    answer: str
    when: str | None = None


@dataclass(frozen=True)
class Preferences:
    """Answers of one person or teacher.

    Attributes:
        pairs: Hash of the pairs that were compared.
        who: The person or the teacher.
        answers: The answers.
    """

    pairs: str
    who: str
    answers: tuple[Answer, ...]

    def to_json(self) -> dict[str, Any]:
        """Return the content of `preferences.json`."""
        return {"format": PREFERENCES, "version": VERSION, **asdict(self)}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Preferences:
        """Return the preferences that `to_json` has written."""
        return cls(data["pairs"], data["who"], tuple(Answer(**one) for one in data["answers"]))

    @classmethod
    def read(cls, path: Path, pairs: Pairs) -> Preferences:
        """Return the answers in a file.

        Raises `ManipError` for a file without answers, `MismatchError` for answers about other
        pairs.
        """
        found = read_file(path, PREFERENCES, cls.from_json)
        if found.pairs != pairs.sha256:
            what, given = "sha256 of the pairs", found.pairs[:12]
            raise MismatchError(what, str(path), given, "the file of pairs", pairs.sha256[:12])
        return found


@dataclass(frozen=True, eq=False)
class Answers:
    """All answers that are `left`, `right` or `equal`.

    Attributes:
        pair: Numbers of the pairs, (A,).
        better: The answers as numbers, see `BETTER`, (A,).
        skipped: Number of other answers.
    """

    pair: I64
    better: F64
    skipped: int


def join_answers(given: Sequence[Preferences]) -> Answers:
    """Join answers.

    Two answers about one pair are two observations, even if they contradict each other.
    """
    every = [one for preferences in given for one in preferences.answers]
    kept = [one for one in every if one.answer in BETTER]
    return Answers(
        np.array([one.pair for one in kept], np.int64),
        np.array([BETTER[one.answer] for one in kept], np.float64),
        len(every) - len(kept),
    )


@dataclass(frozen=True)
class Teacher:
    """A simulated teacher, with B-Pref's parameters.

    Attributes:
        name: The teacher as the user wrote it, see `parse`.
        temperature: 1 / beta; if 0, the better clip is always chosen.
        epsilon: Share of answers that are reversed.
    """

    name: str
    temperature: float = 0.0
    epsilon: float = 0.0

    @classmethod
    def parse(cls, text: str) -> Teacher:
        """Parse `perfect`, `boltzmann[:TEMPERATURE]` or `mistaken[:SHARE]`.

        `UsageError` for anything else.
        """
        name, _, number = text.partition(":")
        try:
            parameter, default, most = TEACHERS[name]
            value = float(number or default)
            if not 0 <= value <= most:
                raise ValueError
        except (LookupError, ValueError):
            raise UsageError(
                f"--teacher is {text!r}; expected perfect, boltzmann:TEMPERATURE or mistaken:SHARE"
            ) from None
        return cls(text, **{parameter: value})


# name -> the parameter that the number after the name sets, its default, and its largest value
TEACHERS = {
    "perfect": ("epsilon", 0.0, 0.0),
    "boltzmann": ("temperature", 1.0, math.inf),
    "mistaken": ("epsilon", 0.1, 1.0),
}


def answer_pairs(teacher: Teacher, clips: Clips, rng: np.random.Generator) -> Preferences:
    """Return a simulated teacher's answers about all pairs.

    Args:
        teacher: The teacher.
        clips: The pairs and their frames.
        rng: Draws the teacher's choices and mistakes; the same state gives the same answers.
    """
    returns = clips.data.progress[clips.rows].sum(-1)
    difference, chance = returns[:, 0] - returns[:, 1], rng.random(len(returns))
    mistaken = rng.random(len(returns)) < teacher.epsilon
    left = difference > 0
    if teacher.temperature:
        left = chance < expit(difference / teacher.temperature)
    found = np.where(left != mistaken, "left", "right")
    if not teacher.temperature:
        found[np.abs(difference) < _ROUNDING] = "equal"
    answers = tuple(Answer(number, one) for number, one in enumerate(found.tolist()))
    return Preferences(clips.pairs.sha256, f"teacher {teacher.name}", answers)
