"""Pairs of clips to compare: `pairs.json`, and the frames of the datasets that it names."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.build import dataset_sha256
from manip_il.data.fingerprint import canonical_json
from manip_il.errors import ManipError, MismatchError
from manip_il.preferences.frames import Frames, read_all

I64 = NDArray[np.int64]
FILE_NAME = "pairs.json"
FORMAT, VERSION = "manip_il pairs", 1
_LARGEST = 64 * 1024 * 1024  # [bytes]


@dataclass(frozen=True)
class Source:
    """A dataset. root: its folder, from where the command ran; sha256: `dataset_sha256`."""

    root: str
    sha256: str
    episodes: int
    frames: int


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
        """Return the inverse of `to_json`."""
        return cls(
            robot=data["robot"],
            task=data["task"],
            control_hz=data["control_hz"],
            length=data["clip"],
            sources=tuple(Source(**one) for one in data["sources"]),
            pairs=tuple((Clip(*left), Clip(*right)) for left, right in data["pairs"]),
            seed=data.get("seed", 0),
            chosen=data.get("chosen", ""),
        )

    @classmethod
    def read(cls, path: Path) -> Pairs:
        """Return the pairs in a file. Raises `ManipError` for what is none."""
        return read_file(path, FORMAT, VERSION, cls.from_json)


def read_file[Read](path: Path, form: str, version: int, make: Callable[[dict[str, Any]], Read]) -> Read:
    """Return what `make` makes of a JSON file of a format and version. Raises `ManipError` for any other file."""
    data = checks.read_json(path, form, _LARGEST)
    if (data.get("format"), data.get("version")) != (form, version):
        found = f"format is {checks.shorten(data.get('format'))}, version {checks.shorten(data.get('version'))}"
        raise ManipError(f"{path}: {found}; expected {form!r}, version {version}")
    try:
        return make(data)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ManipError(f"{path} holds no {form}: {error!r}") from error


@dataclass(frozen=True, eq=False)
class Clips:
    """The clips of pairs in their datasets."""

    pairs: Pairs
    frames: tuple[Frames, ...]

    @cached_property
    def offsets(self) -> I64:
        """Row of the first frame of every source in `inputs`, (S,)."""
        return np.cumsum([0, *(len(one.states) for one in self.frames)])[:-1]

    @cached_property
    def inputs(self) -> NDArray[np.float32]:
        """Inputs of a reward, of all frames, (N, d)."""
        return np.concatenate([one.inputs for one in self.frames])

    @cached_property
    def progress(self) -> NDArray[np.float64] | None:
        """True progress of all frames, (N,); None if a source has none."""
        found = [one.progress for one in self.frames]
        return None if any(one is None for one in found) else np.concatenate([one for one in found if one is not None])

    @cached_property
    def rows(self) -> I64:
        """Rows of the left and the right clips' frames in `inputs`, (P, 2, L)."""
        begin = [
            [self.offsets[clip.source] + self.frames[clip.source].firsts[clip.episode] + clip.first for clip in pair]
            for pair in self.pairs.pairs
        ]
        return np.array(begin, np.int64).reshape(-1, 2, 1) + np.arange(self.pairs.length)


def join_pairs(given: Sequence[Pairs]) -> Pairs:
    """Return the pairs of several files, numbered on. Raises `MismatchError` for two lengths of clips."""
    first = given[0]
    for other in given[1:]:
        if first.length != other.length:
            raise MismatchError("length", "the first file of pairs", first.length, "another", other.length)
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
        if not root.is_dir():
            raise ManipError(f"{root}, which the pairs are from, is not here; run in the folder where they were chosen")
        if (found := dataset_sha256(root)) != source.sha256:
            raise MismatchError(f"sha256 of {root}", "the file of pairs", source.sha256[:12], "the dataset", found[:12])
    return Clips(pairs, tuple(read_all([Path(source.root) for source in pairs.sources])))
