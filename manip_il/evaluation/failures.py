"""An evaluation's result in sentences: where episodes fail, and the phases that they end in."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence

import numpy as np

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.figures import Figure, MapGroup, map_figures
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.tables import BASELINE, CLONING, NO_CONDITION, Table
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import NO_PHASE

MAX_MARKS = 200  # of one outcome on a map; more would hide each other
NOT_RECORDED = "not recorded"
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


def evaluation_facts(result: EvalResult) -> tuple[str, ...]:
    """Return further sentences: main phase, lowest condition, successes that did not last."""
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
    if lost := sum(episode.success and not episode.success_at_end for episode in result.episodes):
        facts.append(f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame.")
    return tuple(facts)


def _main_phase(result: EvalResult) -> str:
    """The phase that most failures ended in; empty if none failed or no phase is known."""
    return next(filter(None, result.failures), "")


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")


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
    return map_figures(groups) if groups else ()
