"""Pairs of clips to compare, chosen evenly or by disagreement of a reward's networks; `pairs.json` and its frames."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from scipy.special import expit

from manip_il import checks
from manip_il.chapter.preferences.frames import Frames, read_all
from manip_il.chapter.reward import LearnedReward
from manip_il.data.build import dataset_sha256
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import F32, F64, I64
from manip_il.worlds.fingerprint import canonical_json

Members = Callable[[F32], F64]  # maps inputs (B, d) to the rewards (M, B) of M networks
POOL = 10  # candidates per pair when choosing by disagreement
_TRIES = 100  # attempts to draw a new pair
FILE_NAME = "pairs.json"
FORMAT, VERSION = "manip_il pairs", 1


@dataclass(frozen=True)
class Source:
    """A dataset. root: its folder when the pairs were chosen, for messages alone; sha256: `dataset_sha256`."""

    root: str
    sha256: str
    episodes: int
    frames: int


class Clip(NamedTuple):
    """The start of a clip: indices of the source, of an episode in it, and of the clip's first frame in the episode."""

    source: int
    episode: int
    first: int


@dataclass(frozen=True, kw_only=True)
class Pairs:
    """Pairs of clips, left and right, of equal length, from datasets of one task.

    clip: length of every clip [control steps]. If lengths differed, the reward's constant offset, which comparisons do
    not determine, would count more often for the longer clip. chosen: how the pairs were chosen, in words.
    """

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
        return {"format": FORMAT, "version": VERSION, **asdict(self)}

    @classmethod
    def from_json(cls, data: dict[str, Any]) -> Pairs:
        """Return the pairs that `to_json` has written."""
        plain = {name: data[name] for name in ("robot", "task", "control_hz", "clip", "seed", "chosen") if name in data}
        sources = tuple(Source(**one) for one in data["sources"])
        return cls(**plain, sources=sources, pairs=tuple((Clip(*left), Clip(*right)) for left, right in data["pairs"]))

    @classmethod
    def read(cls, path: Path) -> Pairs:
        """Return the pairs in a file. Raises `ManipError` for any other file."""
        return read_file(path, FORMAT, VERSION, cls.from_json)


def read_file[Read](path: Path, form: str, version: int, make: Callable[[dict[str, Any]], Read]) -> Read:
    """Return `make(content)` for a JSON file of a format and version. Raises `ManipError` for any other file."""
    data = checks.read_json(path, form)
    try:
        if (data["format"], data["version"]) != (form, version):
            raise ValueError(f"version {data['version']} of {data['format']}")
        return make(data)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise ManipError(f"{path} holds no {form}: {error!r}") from error


@dataclass(frozen=True, eq=False)
class Clips:
    """Pairs together with their datasets, in the order of `Pairs.sources`, and the frames of those."""

    pairs: Pairs
    roots: tuple[Path, ...]
    frames: tuple[Frames, ...]

    @cached_property
    def offsets(self) -> I64:
        """Row of each source's first frame in `inputs`, (S,)."""
        return np.cumsum([0, *(len(one.states) for one in self.frames)])[:-1]

    @cached_property
    def inputs(self) -> F32:
        """A reward's inputs for all frames, (N, d)."""
        return np.concatenate([one.inputs for one in self.frames])

    @cached_property
    def progress(self) -> F64 | None:
        """True progress of all frames, (N,); None if a source has none."""
        found = [one.progress for one in self.frames]
        return None if any(one is None for one in found) else np.concatenate([one for one in found if one is not None])

    @cached_property
    def rows(self) -> I64:
        """Rows of `inputs` that hold the frames of the left and right clips, (P, 2, L)."""
        begin = [
            [self.offsets[clip.source] + self.frames[clip.source].firsts[clip.episode] + clip.first for clip in pair]
            for pair in self.pairs.pairs
        ]
        return np.array(begin, np.int64).reshape(-1, 2, 1) + np.arange(self.pairs.clip)


def join_pairs(given: Sequence[Pairs]) -> Pairs:
    """Join the pairs of several files, numbered consecutively. Raises `MismatchError` if clip lengths differ."""
    first = given[0]
    for other in given[1:]:
        if first.clip != other.clip:
            raise MismatchError("clip length", "the first file of pairs", first.clip, "another", other.clip)
    sources = tuple(dict.fromkeys(source for one in given for source in one.sources))
    joined: list[tuple[Clip, Clip]] = []
    for one in given:
        place = [sources.index(source) for source in one.sources]
        joined += [
            (left._replace(source=place[left.source]), right._replace(source=place[right.source]))
            for left, right in one.pairs
        ]
    return replace(first, sources=sources, pairs=tuple(joined))


def read_clips(pairs: Pairs, roots: Sequence[Path]) -> Clips:
    """Return the clips of pairs.

    Args:
        pairs: The pairs. The paths stored in them are never opened: their datasets are recognised by their hashes.
        roots: Datasets that the user named, in any order, at least those of the pairs.

    Raises `ManipError` if a dataset of the pairs is missing or has changed since.
    """
    found = {dataset_sha256(root): root for root in roots}
    for source in pairs.sources:
        if source.sha256 not in found:
            raise ManipError(f"the pairs' dataset {source.root} is not among the sources, or has changed since")
    used = tuple(found[source.sha256] for source in pairs.sources)
    return Clips(pairs, used, tuple(read_all(used)))


def choose_pairs(
    roots: Sequence[Path],
    length: int,
    count: int,
    seed: int,
    rng: np.random.Generator,
    reward: LearnedReward | None = None,
) -> Clips:
    """Choose pairs of clips of `length` control steps from datasets; episodes shorter than a clip are ignored.

    With `reward`, draw `POOL` times as many pairs, and keep those on which its networks disagree most, by the standard
    deviation of P(left is better) (Christiano et al. 2017, section 2.2.4; Lee et al. 2021). Raises `MismatchError`
    unless datasets and reward have the same task, `ManipError` if there are too few pairs.
    """
    frames = tuple(read_all(roots))
    longest = max(int(one.lengths.max()) for one in frames)
    if longest < length:
        raise ManipError(f"--clip is {length} control steps; the longest episode has {longest}")
    if reward is not None:
        reward.check_fits(str(roots[0]), frames[0].spec)
    drawn = _draw(frames, length, count * (1 if reward is None else POOL), rng)
    if len(drawn) < count:
        raise ManipError(f"--count is {count}; only {len(drawn)} pairs of clips of {length} steps were found")
    spec = frames[0].spec
    made = Pairs(
        robot=spec.robot,
        task=spec.task,
        control_hz=spec.fps,
        clip=length,
        sources=tuple(
            Source(str(root), dataset_sha256(root), len(one.firsts), len(one.states))
            for root, one in zip(roots, frames, strict=True)
        ),
        pairs=tuple(drawn),
        seed=seed,
    )
    if reward is not None:
        spread = disagreement(Clips(made, tuple(roots), frames), reward.members)
        kept = np.sort(np.argsort(-spread, kind="stable")[:count])
        made = replace(made, pairs=tuple(drawn[place] for place in kept), chosen="where rewards disagree")
    return Clips(made, tuple(roots), frames)


def disagreement(clips: Clips, members: Members) -> F64:
    """Return the standard deviation of P(left is better) over the networks of an ensemble, one per pair, (P,)."""
    rows = clips.rows
    rewards = members(clips.inputs[rows.reshape(-1)])
    returns = rewards.reshape(len(rewards), *rows.shape).sum(-1)
    return expit(returns[:, :, 0] - returns[:, :, 1]).std(axis=0)


def _draw(frames: Sequence[Frames], length: int, count: int, rng: np.random.Generator) -> list[tuple[Clip, Clip]]:
    """Distinct pairs of clips; all sources appear equally often. Both clips may be from one source."""
    found = dict[tuple[Clip, Clip], None]()
    sources = [number for number, one in enumerate(frames) if one.lengths.max() >= length]

    def draw(source: int) -> Clip:
        """A clip of a source: a uniformly drawn episode, then a uniformly drawn first frame."""
        lengths = frames[source].lengths
        episode = int(rng.choice(np.flatnonzero(lengths >= length)))
        return Clip(source, episode, int(rng.integers(0, int(lengths[episode]) - length + 1)))

    for left, right in rng.permutation(np.resize(sources, 2 * count)).reshape(count, 2).tolist():
        for _ in range(_TRIES):
            pair = draw(left), draw(right)
            if pair[0] != pair[1] and pair not in found and pair[::-1] not in found:
                found[pair] = None
                break
    return list(found)
