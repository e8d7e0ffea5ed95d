"""What failures go with: success in the lowest, middle and highest third of everything that varied, and how sure."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.evaluation.episode_facts import by_condition, drawn_numbers, goal_of, has_object, start_of
from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.statistics import Proportion
from manip_il.mdp import F64

FEWEST = 9  # episodes that are split into thirds
SAME_PLACE = 0.005  # coordinates that differ by less are one: what settled on the table rests there [m]
THIRDS = ("lowest third", "middle third", "highest third")
_AS_LIKELY = 1e-7  # tables whose chances differ by less than this share are equally likely: rounding


@dataclass(frozen=True)
class Group:
    """Episodes with a factor's value from `low` to `high`."""

    low: float
    high: float
    success: Proportion


@dataclass(frozen=True)
class Factor:
    """Something that varied between episodes. groups: by its value, ascending, at most three; p_value: of one alone.

    corrected: `p_value` times what Holm's correction asks for, at most 1.
    """

    name: str
    groups: tuple[Group, ...]
    p_value: float
    corrected: float = 1.0

    @property
    def shown(self) -> bool:
        """Whether success differs between the groups by more than chance."""
        return self.corrected < 1 - self.groups[0].success.confidence

    @property
    def worst(self) -> int:
        """The group with the lowest success."""
        return min(range(len(self.groups)), key=lambda index: self.groups[index].success.rate)

    @property
    def group_names(self) -> tuple[str, ...]:
        """Of a number that takes two values alone, there are two groups."""
        return THIRDS if len(self.groups) == len(THIRDS) else ("lowest", "highest")


def find_factors(result: EvalResult) -> tuple[Factor, ...]:
    """Return every coordinate and drawn number that varied, those that failures go with the most first.

    Places are taken over all episodes, drawn numbers within the condition that drew them: elsewhere they do not vary,
    and would only tell the condition. Empty where all succeeded, or none did.
    """
    if result.success.successes in (0, result.success.n):
        return ()
    confidence = result.confidence
    columns = {name: column for name, column in _coordinates(result).items() if _span(column) > SAME_PLACE}
    conditions = by_condition(result)
    for condition, episodes in conditions.items():
        prefix = f"{condition}: " if condition and len(conditions) > 1 else ""
        columns |= {prefix + name: column for name, column in _drawn(episodes).items()}
    factors = [made for name, column in columns.items() if (made := _factor(name, column, confidence)) is not None]
    corrected = holm([factor.p_value for factor in factors])
    made = [Factor(f.name, f.groups, f.p_value, p) for f, p in zip(factors, corrected, strict=True)]
    return tuple(sorted(made, key=lambda factor: factor.p_value))


def fisher_exact(successes: Sequence[int], sizes: Sequence[int]) -> float:
    """Return two-sided p that two or three groups have one success rate, by all tables with the same sums.

    Freeman and Halton (1951), Biometrika 38, 141-149; of two groups it is Fisher's exact test. Raises `ManipError` for
    another number of groups, or counts that cannot be.
    """
    if len(successes) != len(sizes) or len(sizes) not in (2, 3):
        raise ManipError(f"{len(successes)} counts of {len(sizes)} groups; expected two or three groups")
    if not all(0 <= count <= size for count, size in zip(successes, sizes, strict=True)):
        raise ManipError(f"successes {list(successes)} of {list(sizes)}; expected 0 to as many as there are")
    (a, b, c), total = (*sizes, 0)[:3], sum(successes)
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(np.arange(1, sum(sizes) + 1)))])

    def log_ways(n: int, k: NDArray[np.int64]) -> F64:
        return log_factorial[n] - log_factorial[k] - log_factorial[n - k]

    observed = sum(float(log_ways(n, np.array([k]))[0]) for n, k in zip(sizes, successes, strict=True))
    every = float(log_ways(sum(sizes), np.array([total]))[0])
    likely = 0.0
    for first in range(max(0, total - b - c), min(a, total) + 1):
        rest = total - first
        second = np.arange(max(0, rest - c), min(b, rest) + 1, dtype=np.int64)
        ways = log_ways(a, np.array([first])) + log_ways(b, second) + log_ways(c, rest - second)
        likely += float(np.exp(ways[ways <= observed + _AS_LIKELY] - every).sum())
    return min(1.0, likely)


def holm(p_values: Sequence[float]) -> list[float]:
    """Return every p corrected for how many there are: Holm (1979), Scand. J. Statist. 6, 65-70."""
    corrected = [1.0] * len(p_values)
    largest = 0.0
    for rank, index in enumerate(sorted(range(len(p_values)), key=lambda i: p_values[i])):
        largest = max(largest, (len(p_values) - rank) * p_values[index])
        corrected[index] = min(1.0, largest)
    return corrected


def _coordinates(result: EvalResult) -> dict[str, list[tuple[float, bool]]]:
    thing = "object" if has_object(result) else "hand"
    columns: dict[str, list[tuple[float, bool]]] = {}

    def add(name: str, value: float, episode: EpisodeResult) -> None:
        columns.setdefault(name, []).append((value, episode.success))

    for episode in result.episodes:
        start, goal = start_of(episode), goal_of(episode)
        # An object starts on the table: its height there is its size, which is a drawn number of its own.
        for name, axes, place in (
            (f"start of the {thing}", "xy" if thing == "object" else "xyz", start),
            ("goal", "xyz", goal),
        ):
            for axis, value in zip(axes, place or (), strict=False):
                add(f"{name}, {axis} [m]", value, episode)
        if start is not None and goal is not None:
            add("distance from start to goal [m]", math.dist(start, goal), episode)
    return columns


def _drawn(episodes: Sequence[EpisodeResult]) -> dict[str, list[tuple[float, bool]]]:
    columns: dict[str, list[tuple[float, bool]]] = {}
    for episode in episodes:
        for name, value in drawn_numbers(episode).items():
            columns.setdefault(name, []).append((value, episode.success))
    return columns


def _factor(name: str, column: Sequence[tuple[float, bool]], confidence: float) -> Factor | None:
    """None for what hardly varies, or for too few episodes."""
    values = np.array([value for value, _ in column])
    if len(column) < FEWEST or _span(column) <= 1e-6 * float(np.abs(values).max()):
        return None
    groups = [
        Group(low, high, Proportion.of([s for value, s in column if low <= value <= high], confidence))
        for low, high in _thirds(values)
    ]
    if len(groups) == 1:  # nearly all values are one
        return None
    counts = [(group.success.successes, group.success.n) for group in groups]
    return Factor(name, tuple(groups), fisher_exact(*zip(*counts, strict=True)))


def _span(column: Sequence[tuple[float, bool]]) -> float:
    values = [value for value, _ in column]
    return max(values) - min(values)


def _thirds(values: F64) -> list[tuple[float, float]]:
    """Smallest and largest value of each third; equal values stay together, so thirds of whole numbers differ."""
    distinct, counts = np.unique(values, return_counts=True)
    below = np.cumsum(counts) - counts / 2  # rank of each value's middle
    third = np.minimum(2, (3 * below / len(values)).astype(int))
    if len(distinct) <= 3:
        third = np.arange(len(distinct))
    groups = [distinct[third == index] for index in range(3)]
    return [(float(group[0]), float(group[-1])) for group in groups if len(group)]
