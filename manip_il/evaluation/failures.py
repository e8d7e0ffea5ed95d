"""The phases that failed episodes ended in, and an evaluation's result in sentences."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass

from manip_il.evaluation.episodes import EpisodeResult
from manip_il.evaluation.factors import Factor, hardest_condition
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.significance import format_p
from manip_il.tasks.table import TASKS
from manip_il.tasks.task import NO_PHASE

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
    facts = (_phase_fact(result), _condition_fact(result), _factor_fact(factors), _end_fact(result))
    return tuple(filter(None, facts))


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
    hardest = hardest_condition(result)
    if hardest is None or result.success.successes in (0, result.success.n):
        return ""
    count = len(result.by_condition)
    if hardest.significant:
        return (
            f"Of {count} conditions {hardest.name} is the hardest: {hardest.success} of {hardest.success.n:,} "
            f"episodes, against all others {format_p(hardest.p_value)} (Fisher's exact test, corrected for the choice)."
        )
    return f"No condition of the {count} is shown to be harder than the others."


def _factor_fact(factors: Sequence[Factor]) -> str:
    if not factors or not factors[0].significant:
        return ""
    first = factors[0]
    worst = first.bins[first.worst]
    best = max(first.bins, key=lambda one: one.success.rate)
    names = dict(zip(first.bins, first.bin_names, strict=True))
    return (
        f"Failures are associated most with {first.name}. "
        f"{format_percent(worst.success.rate)} succeed in its {names[worst]} "
        f"({worst.low:.3g} to {worst.high:.3g}), {format_percent(best.success.rate)} in its {names[best]}, "
        f"corrected {format_p(first.corrected)}."
    )


def _end_fact(result: EvalResult) -> str:
    lost = sum(episode.success and not episode.success_at_end for episode in result.episodes)
    return f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame." if lost else ""


def _spaced(phase: str) -> str:
    return phase.replace("_", " ")
