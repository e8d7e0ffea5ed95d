"""The phases that failed episodes ended in, what failures depend on, and an evaluation's result in sentences."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from manip_il.evaluation.episodes import EpisodeResult, moving_thing
from manip_il.evaluation.intervals import Proportion, format_percent
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.significance import fisher_exact, format_p, format_p_cell, holm
from manip_il.evaluation.tables import NO_CONDITION, WORST, Table
from manip_il.mdp import F64
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import NO_PHASE

MIN_EPISODES = 9  # that are split into thirds
SAME_PLACE = 0.005  # coordinates that differ by less are one: what settled on the table rests there [m]
THIRDS = ("lowest third", "middle third", "highest third")
NOT_RECORDED = "not recorded"
_NO_PHASE = "not even the expert can continue: an object is off the table, or something is out of reach"


@dataclass(frozen=True)
class PhaseRow:
    """A phase's name, its meaning, and the failed episodes that ended in it, one count a policy."""

    name: str
    meaning: str
    counts: tuple[int, ...]


def phase_rows(policies: Sequence[Sequence[EpisodeResult]], task: str) -> tuple[PhaseRow, ...]:
    """Return the phases of a task in order, then those of the episodes that the task does not have."""
    counted = [Counter(e.phase_at_end or NOT_RECORDED for e in episodes if not e.success) for episodes in policies]
    meanings = phase_meanings(task)
    others = sorted({name for counts in counted for name in counts} - meanings.keys())
    names = meanings | dict.fromkeys(others, "")
    return tuple(PhaseRow(name, words, tuple(counts[name] for counts in counted)) for name, words in names.items())


def phase_meanings(task: str) -> dict[str, str]:
    """Return phase -> meaning, from the first to the last; empty for a task that is not known here."""
    if task not in TASKS:
        return {}
    return {rung.name: rung.words for rung in reversed(TASKS[task].rungs)} | {NO_PHASE: _NO_PHASE}


def evaluation_verdict(result: EvalResult) -> str:
    """Return the first sentence: success with its interval, the phase that failures end in, the hardest condition."""
    success, episodes = result.success, f"unseen episodes of {result.robot} {result.task}"
    if success.successes == success.n:
        return f"{result.policy} succeeds in all {success.n:,} {episodes}: {success}."
    failed = success.n - success.successes
    if success.successes == 0:
        parts = [f"{result.policy} fails in all {success.n:,} {episodes}: {success}"]
    else:
        parts = [f"{result.policy} succeeds in {success} of {success.n:,} {episodes}"]
    if phase := _main_phase(result):
        count = result.failures[phase]
        share = f"{count:,} of its {failed:,} failures end" if failed > 1 else "its one failure ends"
        parts.append(f"{share} in the phase {_spaced(phase)}")
    hardest = hardest_condition(result)
    if hardest is not None and hardest.significant:
        parts.append(f"{hardest.name} is its hardest condition, with {format_percent(hardest.success.rate)}")
    return "; ".join(parts) + "."


def evaluation_facts(result: EvalResult, factors: Sequence[Factor]) -> tuple[str, ...]:
    """Return further sentences: main phase, hardest condition, first factor, successes that did not last."""
    lost = sum(episode.success and not episode.success_at_end for episode in result.episodes)
    ends = f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame." if lost else ""
    return tuple(filter(None, (_phase_fact(result), _condition_fact(result), _factor_fact(factors), ends)))


def _main_phase(result: EvalResult) -> str:
    """The phase that most failures ended in; empty where none failed or no phase is known."""
    return next(filter(None, result.failures), "")


def _phase_fact(result: EvalResult) -> str:
    phase = _main_phase(result)
    if not phase:
        return f"The phase of failures is {NOT_RECORDED}." if result.failures else ""
    meaning = phase_meanings(result.task).get(phase)
    return f"{_spaced(phase).capitalize()}, where failures end most often: {meaning}." if meaning else ""


def _condition_fact(result: EvalResult) -> str:
    hardest, count = hardest_condition(result), len(result.by_condition)
    if hardest is None or result.success.successes in (0, result.success.n):
        return ""
    if not hardest.significant:
        return f"No condition of the {count} is shown to be harder than the others."
    return (
        f"Of {count} conditions {hardest.name} is the hardest: {hardest.success} of {hardest.success.n:,} "
        f"episodes, against all others {format_p(hardest.p_value)} (Fisher's exact test, corrected for the choice)."
    )


def _factor_fact(factors: Sequence[Factor]) -> str:
    if not factors or not factors[0].significant:
        return ""
    first = factors[0]
    # A number that takes two values alone has two bins.
    names = THIRDS if len(first.bins) == len(THIRDS) else ("lowest", "highest")
    worst = first.bins[first.worst]
    best, of_best = max(zip(first.bins, names, strict=True), key=lambda one: one[0].success.rate)
    return (
        f"Failures are associated most with {first.name}. "
        f"{format_percent(worst.success.rate)} succeed in its {names[first.worst]} "
        f"({worst.low:.3g} to {worst.high:.3g}), {format_percent(best.success.rate)} in its {of_best}, "
        f"corrected {format_p(first.corrected)}."
    )


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")


@dataclass(frozen=True)
class Bin:
    """Episodes with a factor's value from `low` to `high`."""

    low: float
    high: float
    success: Proportion


@dataclass(frozen=True)
class Factor:
    """A number that varied between episodes, with success in its bins, ascending, at most three.

    p_value: of this factor alone. corrected: the same, corrected for the number of factors (Holm).
    """

    name: str
    bins: tuple[Bin, ...]
    p_value: float
    corrected: float = 1.0

    @property
    def significant(self) -> bool:
        """Whether success differs between the bins by more than chance."""
        return self.corrected < 1 - self.bins[0].success.confidence

    @property
    def worst(self) -> int:
        """The bin with the lowest success."""
        return min(range(len(self.bins)), key=lambda index: self.bins[index].success.rate)


@dataclass(frozen=True)
class HardestCondition:
    """The condition with the lowest success. p_value: against all others, corrected for the choice (Holm)."""

    name: str
    success: Proportion
    p_value: float

    @property
    def significant(self) -> bool:
        """Whether it is harder by more than chance."""
        return self.p_value < 1 - self.success.confidence


def find_factors(result: EvalResult) -> tuple[Factor, ...]:
    """Return every coordinate and drawn number that varied, the smallest p first.

    Places are taken over all episodes, drawn numbers within the condition that drew them, as they are constant
    elsewhere. Empty where all episodes succeeded, or none did.
    """
    if result.success.successes in (0, result.success.n):
        return ()
    places = _coordinates(result.episodes).items()
    columns = {name: column for name, column in places if np.ptp([value for value, _ in column]) > SAME_PLACE}
    conditions = result.by_condition
    for condition, part in conditions.items():
        prefix = f"{condition}: " if condition and len(conditions) > 1 else ""
        for episode in part.episodes:
            for name, value in episode.drawn_numbers.items():
                columns.setdefault(prefix + name, []).append((value, episode.success))
    made = (_factor(name, column, result.confidence) for name, column in columns.items())
    factors = sorted((factor for factor in made if factor is not None), key=lambda factor: factor.p_value)
    corrected = holm([factor.p_value for factor in factors])
    return tuple(replace(factor, corrected=p) for factor, p in zip(factors, corrected, strict=True))


def hardest_condition(result: EvalResult) -> HardestCondition | None:
    """Return the condition with the lowest success; None where there is one condition alone."""
    parts = {name or NO_CONDITION: part.success for name, part in result.by_condition.items()}
    if len(parts) < 2:
        return None
    total = result.success
    p_values = [
        fisher_exact((part.successes, total.successes - part.successes), (part.n, total.n - part.n))
        for part in parts.values()
    ]
    ranked = zip(parts.items(), holm(p_values), strict=True)
    (worst, success), p_value = min(ranked, key=lambda one: one[0][1].rate)
    return HardestCondition(worst, success, p_value)


def factor_table(factors: Sequence[Factor]) -> Table:
    """Return success in the thirds of each factor, the lowest of a significant factor marked, and the corrected p."""
    rows: list[tuple[str, ...]] = []
    for factor in factors:
        cells = [_bin_cell(one, factor.significant and index == factor.worst) for index, one in enumerate(factor.bins)]
        if len(cells) == 2:  # of two values there is no middle
            cells.insert(1, "")
        rows.append((factor.name, *cells, format_p_cell(factor.corrected)))
    return Table(("number", *THIRDS, "corrected p"), tuple(rows))


def _bin_cell(one: Bin, marked: bool) -> str:
    low, high = one.success.interval
    values = f"{one.low:.3g}" if one.low == one.high else f"{one.low:.3g} to {one.high:.3g}"
    rate = f"{format_percent(one.success.rate)} [{100 * low:.1f}, {100 * high:.1f}]"
    return f"{WORST if marked else ''}{rate}\n{values}"


def _coordinates(episodes: Sequence[EpisodeResult]) -> dict[str, list[tuple[float, bool]]]:
    thing = moving_thing(episodes)
    columns: defaultdict[str, list[tuple[float, bool]]] = defaultdict(list)
    for episode in episodes:
        start, goal = episode.start, episode.goal
        # An object starts on the table: its height there is its size, which is a drawn number of its own.
        axes = "xy" if thing == "object" else "xyz"
        values = {f"start of the {thing}, {a} [m]": v for a, v in zip(axes, start or (), strict=False)}
        values |= {f"goal, {axis} [m]": value for axis, value in zip("xyz", goal or (), strict=False)}
        if start is not None and goal is not None:
            values["distance from start to goal [m]"] = math.dist(start, goal)
        for name, value in values.items():
            columns[name].append((value, episode.success))
    return columns


def _factor(name: str, column: Sequence[tuple[float, bool]], confidence: float) -> Factor | None:
    """None for what hardly varies, or for too few episodes."""
    values = np.array([value for value, _ in column])
    if len(column) < MIN_EPISODES or np.ptp(values) <= 1e-6 * np.abs(values).max():
        return None
    bins = [
        Bin(low, high, Proportion.of([success for value, success in column if low <= value <= high], confidence))
        for low, high in _thirds(values)
    ]
    if len(bins) == 1:  # nearly all values are one
        return None
    return Factor(name, tuple(bins), fisher_exact([b.success.successes for b in bins], [b.success.n for b in bins]))


def _thirds(values: F64) -> list[tuple[float, float]]:
    """Smallest and largest value of each third; equal values stay together, so thirds of whole numbers differ."""
    distinct, counts = np.unique(values, return_counts=True)
    below = np.cumsum(counts) - counts / 2  # rank of each value's middle
    third = np.minimum(2, (3 * below / len(values)).astype(int))
    if len(distinct) <= 3:
        third = np.arange(len(distinct))
    bins = [distinct[third == index] for index in range(3)]
    return [(float(values[0]), float(values[-1])) for values in bins if len(values)]
