"""Pairs of clips to compare: `pairs.json`, and the frames of the datasets that it names."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.build import dataset_sha256
from manip_il.data.fingerprint import canonical_json
from manip_il.data.schema import MOST_FPS
from manip_il.errors import ManipError, MismatchError
from manip_il.preferences.frames import Frames, check_same, read_frames

I64 = NDArray[np.int64]
_MOST_FRAMES = 1_000_000  # of a clip
FILE_NAME = "pairs.json"
FORMAT, VERSION = "manip_il pairs", 1
MOST_PAIRS, MOST_SOURCES, MOST_EPISODES = 100_000, 1_000, 10_000_000
_LARGEST = 64 * 1024 * 1024  # [bytes]
_SHA256 = 64  # characters


@dataclass(frozen=True)
class Source:
    """A dataset. root: its folder, from where the command ran; sha256: `dataset_sha256`."""

    root: str
    sha256: str
    episodes: int
    frames: int

    def __post_init__(self) -> None:
        checks.text("root of a source", self.root, 4_096)
        if len(checks.text("sha256 of a source", self.sha256, _SHA256)) != _SHA256:
            raise ManipError(f"sha256 of a source is {checks.shorten(self.sha256)}; expected {_SHA256} characters")
        checks.whole("episodes of a source", self.episodes, 1, MOST_EPISODES)
        checks.whole("frames of a source", self.frames, 1, MOST_EPISODES * 1_000)


@dataclass(frozen=True)
class Clip:
    """The beginning of a clip: number of the source, of its episode, and of the episode's frame."""

    source: int
    episode: int
    first: int


@dataclass(frozen=True)
class Pairs:
    """Pairs of clips of one length, the left one and the right one, in the datasets of one task.

    length: of every clip [control steps]. With clips of different lengths the longer one would collect the reward's
    constant more often, which no comparison tells. chosen: how, in words.
    """

    robot: str
    task: str
    control_hz: int
    length: int
    sources: tuple[Source, ...]
    pairs: tuple[tuple[Clip, Clip], ...]
    seed: int = 0
    chosen: str = "evenly"

    def __post_init__(self) -> None:
        checks.name("robot", self.robot)
        checks.name("task", self.task)
        checks.whole("control_hz", self.control_hz, 1, MOST_FPS)
        checks.whole("clip", self.length, 1, _MOST_FRAMES)
        checks.whole("seed", self.seed, 0, checks.LARGEST_SEED)
        checks.text("chosen", self.chosen, checks.LONGEST_TEXT)
        if not checks.array("sources", self.sources, MOST_SOURCES):
            raise ManipError("sources are empty; expected datasets that the clips are from")
        for number, pair in enumerate(checks.array("pairs", self.pairs, MOST_PAIRS)):
            for clip in pair:
                self._check_clip(f"pair {number}", clip)
            if pair[0] == pair[1]:
                raise ManipError(f"pair {number} is twice the clip {asdict(pair[0])}; expected two clips")

    def _check_clip(self, what: str, clip: Clip) -> None:
        checks.whole(f"{what}: source", clip.source, 0, len(self.sources) - 1)
        checks.whole(f"{what}: episode", clip.episode, 0, self.sources[clip.source].episodes - 1)
        checks.whole(f"{what}: first", clip.first, 0, _MOST_FRAMES)

    def __len__(self) -> int:
        return len(self.pairs)

    @cached_property
    def sha256(self) -> str:
        """Hash of everything: by it answers say which pairs they are about."""
        return hashlib.sha256(canonical_json(self.to_json()).encode()).hexdigest()

    def to_json(self) -> dict[str, Any]:
        """Return everything for `pairs.json`, a clip as [source, episode, first frame]."""
        return {
            "format": FORMAT,
            "version": VERSION,
            "robot": self.robot,
            "task": self.task,
            "control_hz": self.control_hz,
            "clip": self.length,
            "seed": self.seed,
            "chosen": self.chosen,
            "sources": [asdict(source) for source in self.sources],
            "pairs": [[[clip.source, clip.episode, clip.first] for clip in pair] for pair in self.pairs],
        }

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Pairs:
        """Return the inverse of `to_json`. Raises `ManipError` for what no pairs hold."""
        check_format(data, FORMAT, VERSION)
        if missing := {"robot", "task", "control_hz", "clip", "sources", "pairs"} - data.keys():
            raise ManipError(f"pairs without {', '.join(sorted(missing))}")
        sources = [checks.mapping("a source", one) for one in checks.array("sources", data["sources"], MOST_SOURCES)]
        return cls(
            robot=data["robot"],
            task=data["task"],
            control_hz=data["control_hz"],
            length=data["clip"],
            sources=tuple(_source(one) for one in sources),
            pairs=tuple(_pair(number, one) for number, one in enumerate(checks.array("pairs", data["pairs"]))),
            seed=data.get("seed", 0),
            chosen=data.get("chosen", ""),
        )

    @classmethod
    def read(cls, path: Path) -> Pairs:
        """Return the pairs in a file. Raises `ManipError` naming it for what they cannot be."""
        data = checks.read_json(path, "pairs of manip-il reward pairs", _LARGEST)
        try:
            return cls.from_json(data)
        except ManipError as error:
            raise ManipError(f"{path}: {error}") from error


@dataclass(frozen=True, eq=False)
class Clips:
    """The clips of pairs in their datasets. rows: of the left and right clips' frames, (P, 2, L), in `inputs`.

    offsets: row of the first frame of every source, (S,).
    """

    pairs: Pairs
    frames: tuple[Frames, ...]
    offsets: I64 = field(init=False, repr=False)

    def __post_init__(self) -> None:
        counts = [len(one.states) for one in self.frames]
        object.__setattr__(self, "offsets", np.cumsum([0, *counts])[:-1])

    @cached_property
    def inputs(self) -> NDArray[np.float32]:
        """Inputs of a reward, of all frames, (N, d)."""
        return np.concatenate([one.inputs for one in self.frames])

    @cached_property
    def progress(self) -> NDArray[np.float64] | None:
        """True progress of all frames, (N,); None where a source has none."""
        found = [one.progress for one in self.frames]
        return None if any(one is None for one in found) else np.concatenate([one for one in found if one is not None])

    @cached_property
    def rows(self) -> I64:
        """Rows of every clip's frames, (P, 2, L)."""
        begin = [[self._first_row(number, clip) for clip in pair] for number, pair in enumerate(self.pairs.pairs)]
        return np.array(begin, np.int64).reshape(-1, 2, 1) + np.arange(self.pairs.length)

    def _first_row(self, number: int, clip: Clip) -> int:
        frames = self.frames[clip.source]
        if clip.episode >= len(frames.firsts) or clip.first + self.pairs.length > frames.lengths[clip.episode]:
            raise ManipError(
                f"pair {number}: {self.pairs.sources[clip.source].root} has no {self.pairs.length} frames from frame "
                f"{clip.first} of episode {clip.episode}"
            )
        return int(self.offsets[clip.source] + frames.firsts[clip.episode] + clip.first)


def join_pairs(given: Sequence[Pairs]) -> Pairs:
    """Return the pairs of several files, numbered one after another.

    Raises `MismatchError` where clips differ in robot, task, rate or length.
    """
    first = given[0]
    for name in ("robot", "task", "control_hz", "length"):
        for other in given[1:]:
            if (one := getattr(first, name)) != (two := getattr(other, name)):
                raise MismatchError(name, "the first file of pairs", one, "another", two)
    sources = tuple(dict.fromkeys(source for one in given for source in one.sources))
    joined: list[tuple[Clip, Clip]] = []
    for one in given:
        place = [sources.index(source) for source in one.sources]
        joined += [
            (replace(left, source=place[left.source]), replace(right, source=place[right.source]))
            for left, right in one.pairs
        ]
    return replace(first, sources=sources, pairs=tuple(joined))


def read_clips(pairs: Pairs) -> Clips:
    """Return the clips of pairs. Raises `ManipError` for a dataset that is not there or was changed since."""
    for source in pairs.sources:
        root = Path(source.root)
        if not (root / "meta" / "info.json").is_file():
            raise ManipError(f"{root}, which the pairs are from, is not here; run in the folder where they were chosen")
        if (found := dataset_sha256(root)) != source.sha256:
            raise MismatchError(f"sha256 of {root}", "the file of pairs", source.sha256[:12], "the dataset", found[:12])
    return Clips(pairs, tuple(read_all([Path(source.root) for source in pairs.sources])))


def read_all(roots: Sequence[Path]) -> list[Frames]:
    """Return the frames of datasets. Raises `MismatchError` unless they are of one robot and task."""
    found: list[Frames] = []
    for root in roots:
        found.append(read_frames(root))
        check_same(str(roots[0]), found[0].spec, str(root), found[-1].spec)
    return found


def check_format(data: dict[str, Any], form: str, version: int) -> None:
    """Raise `ManipError` unless a file says that it has this form and version."""
    if data.get("format") != form:
        raise ManipError(f"format is {checks.shorten(data.get('format'))}; expected {form!r}")
    if data.get("version") != version:
        raise ManipError(f"version is {checks.shorten(data.get('version'))}; this program reads {version}")


def _source(data: dict[str, Any]) -> Source:
    if data.keys() != {"root", "sha256", "episodes", "frames"}:
        raise ManipError(f"a source has {checks.shorten(sorted(data))}; expected root, sha256, episodes, frames")
    return Source(**data)


def _pair(number: int, data: Any) -> tuple[Clip, Clip]:
    clips = [checks.array(f"a clip of pair {number}", one, 3) for one in checks.array(f"pair {number}", data, 2)]
    if len(clips) != 2 or any(len(clip) != 3 for clip in clips):
        raise ManipError(f"pair {number} is {checks.shorten(data)}; expected two of [source, episode, first frame]")
    left, right = (Clip(*clip) for clip in clips)
    return left, right
