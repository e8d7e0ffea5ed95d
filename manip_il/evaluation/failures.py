"""An evaluation's result in sentences: the phases that failed episodes ended in, and what failures go with."""

from __future__ import annotations

import math
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, cast

import numpy as np
from scipy import stats

from manip_il.evaluation.episodes import EpisodeResult, moving_thing
from manip_il.evaluation.figures import Figure, MapGroup, map_figures
from manip_il.evaluation.intervals import CONFIDENCE
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.significance import format_p, holm
from manip_il.evaluation.tables import BASELINE, CLONING, NO_CONDITION, Table
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import NO_PHASE

MAX_MARKS = 600  # of one outcome on a map; more would hide each other
NOT_RECORDED = "not recorded"
_FEWEST = 5  # of failed and of solved episodes, to ask what failures go with
_SAME_PLACE = 0.005  # coordinates that differ by less are one: what settled on the table rests there [m]
_NO_PHASE = "not even the expert can continue: an object is off the table, or something is out of reach"


def phase_meanings(task: str) -> dict[str, str]:
    """Return phase -> meaning, from the first to the last; empty for a task that is not known here."""
    if task not in TASKS:
        return {}
    return {rung.name: rung.words for rung in reversed(TASKS[task].rungs)} | {NO_PHASE: _NO_PHASE}


def phase_table(policies: Sequence[tuple[str, Sequence[EpisodeResult]]], task: str) -> Table | None:
    """Return failed episodes by the phase that they ended in, in the order of the task, a column a policy.

    policies: names and episodes. None if none failed or no phase is known.
    """
    counted = [Counter(e.phase_at_end or NOT_RECORDED for e in own if not e.success) for _, own in policies]
    found = {name for counts in counted for name in counts}
    if not found - {NOT_RECORDED}:
        return None
    meanings = phase_meanings(task)
    names = [*meanings, *sorted(found - meanings.keys())]
    rows = (
        (f"{_spaced(name)}\n{meanings.get(name, '')}".rstrip(), *(f"{counts[name]:,}" for counts in counted))
        for name in names
    )
    return Table(("phase that it ended in", *(name for name, _ in policies)), tuple(rows))


def evaluation_verdict(result: EvalResult) -> str:
    """Return the first sentence: success with its interval, and the phase that failures end in."""
    success, episodes = result.success, f"unseen episodes of {result.robot} {result.task}"
    failed = success.n - success.successes
    if not failed:
        return f"{result.policy} succeeds in all {success.n:,} {episodes}: {success}."
    if success.successes == 0:
        parts = [f"{result.policy} fails in all {success.n:,} {episodes}: {success}"]
    else:
        parts = [f"{result.policy} succeeds in {success} of {success.n:,} {episodes}"]
    if phase := _main_phase(result):
        count = result.failures[phase]
        share = f"{count:,} of its {failed:,} failures end" if failed > 1 else "its one failure ends"
        parts.append(f"{share} in the phase {_spaced(phase)}")
    return "; ".join(parts) + "."


def evaluation_facts(result: EvalResult, factors: Sequence[Factor]) -> tuple[str, ...]:
    """Return further sentences: main phase, lowest condition, first factor, successes that did not last."""
    facts: list[str] = []
    if phase := _main_phase(result):
        meaning = phase_meanings(result.task).get(phase)
        facts += [f"{_spaced(phase).capitalize()}, where failures end most often: {meaning}."] if meaning else []
    elif result.failures:
        facts.append(f"The phase of failures is {NOT_RECORDED}.")
    rates = {name or NO_CONDITION: part.success for name, part in result.by_condition.items()}
    if len(rates) > 1 and result.failures:
        worst = min(rates, key=lambda name: rates[name].rate)
        facts.append(f"Of {len(rates)} conditions {worst} has the lowest success: {rates[worst]}.")
    if factors and factors[0].significant:
        first = factors[0]
        facts.append(
            f"Failures go most with {first.name}: median {first.failed[1]:.3g} where it failed, {first.solved[1]:.3g} "
            f"where it succeeded, corrected {format_p(first.corrected)}."
        )
    if lost := sum(episode.success and not episode.success_at_end for episode in result.episodes):
        facts.append(f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame.")
    return tuple(facts)


def _main_phase(result: EvalResult) -> str:
    """The phase that most failures ended in; empty if none failed or no phase is known."""
    return next(filter(None, result.failures), "")


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")


@dataclass(frozen=True)
class Factor:
    """A number that varied between episodes. failed, solved: its quartiles where episodes failed and where not.

    p_value: Kolmogorov and Smirnov's, that both are of one distribution. corrected: the same, corrected for the number
    of factors (Holm).
    """

    name: str
    failed: tuple[float, float, float]
    solved: tuple[float, float, float]
    p_value: float
    corrected: float = 1.0

    @property
    def significant(self) -> bool:
        """Whether failed and solved episodes differ in it by more than chance."""
        return self.corrected < 1 - CONFIDENCE


def find_factors(result: EvalResult) -> tuple[Factor, ...]:
    """Return every coordinate and drawn number that varied, the smallest p first.

    Places are taken over all episodes, drawn numbers within the condition that drew them, as they are constant
    elsewhere. Numbers of fewer than a few failed or solved episodes are left out.
    """
    places = _coordinates(result.episodes).items()
    columns = {name: column for name, column in places if np.ptp([value for value, _ in column]) > _SAME_PLACE}
    conditions = result.by_condition
    for condition, part in conditions.items():
        prefix = f"{condition}: " if condition and len(conditions) > 1 else ""
        for episode in part.episodes:
            for name, value in episode.drawn_numbers.items():
                columns.setdefault(prefix + name, []).append((value, episode.success))
    factors: list[Factor] = []
    for name, column in columns.items():
        failed, solved = ([value for value, success in column if success == good] for good in (False, True))
        if min(len(failed), len(solved)) >= _FEWEST and len({value for value, _ in column}) > 1:
            p = float(cast(Any, stats.ks_2samp(failed, solved)).pvalue)
            factors.append(Factor(name, _quartiles(failed), _quartiles(solved), p))
    factors.sort(key=lambda factor: factor.p_value)
    corrected = holm([factor.p_value for factor in factors])
    return tuple(replace(factor, corrected=p) for factor, p in zip(factors, corrected, strict=True))


def factor_table(factors: Sequence[Factor]) -> Table:
    """Return the medians and quartiles of each factor where episodes failed and where not, and the corrected p."""
    rows = (
        (one.name, _quartile_cell(one.failed), _quartile_cell(one.solved), format_p(one.corrected)) for one in factors
    )
    return Table(("number", "failed: median [quartiles]", "solved: median [quartiles]", "corrected p"), tuple(rows))


def _quartiles(values: Sequence[float]) -> tuple[float, float, float]:
    low, median, high = np.quantile(values, (0.25, 0.5, 0.75)).tolist()
    return low, median, high


def _quartile_cell(quartiles: tuple[float, float, float]) -> str:
    low, median, high = quartiles
    return f"{median:.3g} [{low:.3g}, {high:.3g}]"


def _coordinates(episodes: Sequence[EpisodeResult]) -> dict[str, list[tuple[float, bool]]]:
    thing = moving_thing(episodes)
    axes = "xy" if thing == "object" else "xyz"  # an object's height on the table is its size, a number of its own
    columns: defaultdict[str, list[tuple[float, bool]]] = defaultdict(list)
    for episode in episodes:
        start, goal = episode.start, episode.goal
        values = {f"start of the {thing}, {a} [m]": v for a, v in zip(axes, start or (), strict=False)}
        values |= {f"goal, {axis} [m]": value for axis, value in zip("xyz", goal or (), strict=False)}
        if start is not None and goal is not None:
            values["distance from start to goal [m]"] = math.dist(start, goal)
        for name, value in values.items():
            columns[name].append((value, episode.success))
    return columns


def failure_maps(result: EvalResult) -> tuple[Figure, ...]:
    """Draw where episodes started and were to go, failed and solved; no figure if no episode has its places."""
    failed, solved = ([one for one in result.episodes if one.success == good] for good in (False, True))
    return map_groups((("solved", BASELINE, solved), ("failed, from start to goal", CLONING, failed)))


def map_groups(outcomes: Sequence[tuple[str, str, Sequence[EpisodeResult]]]) -> tuple[Figure, ...]:
    """Draw episodes by outcome (name, colour, episodes), the first, the solved ones, pale; the last on top."""
    groups: list[MapGroup] = []
    for name, colour, episodes in outcomes:
        known = [
            (start, goal, None if one.success else one.end)
            for one in episodes
            if (start := one.start) is not None and (goal := one.goal) is not None
        ]
        if known:
            kept = np.unique(np.linspace(0, len(known) - 1, min(len(known), MAX_MARKS)).round().astype(int)).tolist()
            groups.append(MapGroup(name, colour, tuple(known[index] for index in kept), joined=name != outcomes[0][0]))
    thing = moving_thing([one for *_, episodes in outcomes for one in episodes])
    return map_figures(groups, thing) if groups else ()
