"""Which clips are compared: evenly over sources and episodes, or where rewards disagree."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from manip_il.data.build import dataset_sha256
from manip_il.errors import ManipError
from manip_il.preferences.frames import Frames, read_all
from manip_il.preferences.pairs import Clip, Clips, Pairs, Source

F32, F64 = NDArray[np.float32], NDArray[np.float64]
Members = Callable[[F32], F64]  # rewards (M, B) of inputs (B, d)
POOL = 10  # pairs that each is chosen from, by disagreement
_TRIES = 100  # draws of a pair that is not there yet


@dataclass(frozen=True, eq=False)
class Supply:
    """Datasets that clips of `length` control steps are drawn from."""

    roots: tuple[Path, ...]
    frames: tuple[Frames, ...]
    length: int

    @property
    def too_short(self) -> int:
        """Number of episodes that no clip is from."""
        return sum(int((one.lengths < self.length).sum()) for one in self.frames)

    def draw(self, source: int, rng: np.random.Generator) -> Clip:
        """Return one clip of a source: every episode alike, every place in it alike."""
        lengths = self.frames[source].lengths
        episode = int(rng.choice(np.flatnonzero(lengths >= self.length)))
        return Clip(source, episode, int(rng.integers(0, int(lengths[episode]) - self.length + 1)))


def open_supply(roots: Sequence[Path], length: int) -> Supply:
    """Read datasets. Raises `MismatchError` unless they are of one task, `ManipError` if all episodes are short."""
    supply = Supply(tuple(roots), tuple(read_all(roots)), length)
    longest = max(int(one.lengths.max()) for one in supply.frames)
    if longest < length:
        raise ManipError(f"--clip is {length} control steps; the longest episode has {longest}")
    return supply


def choose_pairs(
    supply: Supply, count: int, seed: int, rng: np.random.Generator, members: Members | None = None
) -> Pairs:
    """Return pairs; with `members`, those of `POOL` times as many about which the ensemble disagrees most.

    The disagreement about a pair is the standard deviation over the ensemble of P(left is better) (Christiano et al.
    2017, section 2.2.4; Lee et al. 2021).
    """
    drawn = _draw(supply, count * (POOL if members is not None else 1), rng)
    if len(drawn) < count:
        raise ManipError(f"--count is {count}; {len(drawn)} pairs of clips of {supply.length} steps were found")
    spec = supply.frames[0].spec
    made = Pairs(
        robot=spec.robot,
        task=spec.task,
        control_hz=spec.fps,
        length=supply.length,
        sources=tuple(
            Source(str(root), dataset_sha256(root), len(one.firsts), len(one.states))
            for root, one in zip(supply.roots, supply.frames, strict=True)
        ),
        pairs=tuple(drawn),
        seed=seed,
    )
    if members is None:
        return made
    doubt = disagreement(Clips(made, supply.frames), members)
    kept = np.sort(np.argsort(-doubt, kind="stable")[:count])
    return replace(made, pairs=tuple(made.pairs[place] for place in kept.tolist()), chosen="where rewards disagree")


def disagreement(clips: Clips, members: Members) -> F64:
    """Return the standard deviation of P(left is better) over an ensemble, of every pair (P,)."""
    rows = clips.rows
    rewards = members(clips.inputs[rows.reshape(-1)])
    returns = rewards.reshape(len(rewards), *rows.shape).sum(-1)
    return (1 / (1 + np.exp(-np.clip(returns[:, :, 0] - returns[:, :, 1], -50, 50)))).std(axis=0)


def _draw(supply: Supply, count: int, rng: np.random.Generator) -> list[tuple[Clip, Clip]]:
    """Different pairs of clips; every source is in as many as any other, with another or itself."""
    found = dict[tuple[Clip, Clip], None]()
    sources = [number for number, one in enumerate(supply.frames) if one.lengths.max() >= supply.length]
    for left, right in rng.permutation(np.resize(sources, 2 * count)).reshape(count, 2).tolist():
        for _ in range(_TRIES):
            pair = supply.draw(left, rng), supply.draw(right, rng)
            if pair[0] != pair[1] and pair not in found and pair[::-1] not in found:
                found[pair] = None
                break
    return list(found)
