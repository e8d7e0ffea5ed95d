"""An evaluation in sentences: how good, and what to act on."""

from __future__ import annotations

from manip_il.evaluation.condition_chart import hardest
from manip_il.evaluation.episode_facts import by_condition
from manip_il.evaluation.factors import Factor
from manip_il.evaluation.phase_chart import NOT_TOLD, phase_words
from manip_il.evaluation.report_data import format_percent
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.statistics import format_p


def eval_verdict(result: EvalResult, episodes: str = "unseen episodes") -> str:
    """Return the first sentence: success with its interval, the phase that failures end in, the hardest condition.

    episodes: what they are called.
    """
    success, where = result.success, f"{episodes} of {result.robot} {result.task}"
    if success.successes == success.n:
        return f"{result.policy} succeeds in all {success.n:,} {where}: {success}."
    failed = success.n - success.successes
    if success.successes == 0:
        said = f"{result.policy} fails in all {success.n:,} {where}: {success}"
    else:
        said = f"{result.policy} succeeds in {success} of {success.n:,} {where}"
    parts = [said]
    if phase := main_phase(result):
        name, count = phase
        share = f"{count:,} of its {failed:,} failures end" if failed > 1 else "its one failure ends"
        parts.append(f"{share} in the phase {_named(name)}")
    worst = hardest(result)
    if worst is not None and worst.shown:
        parts.append(f"{worst.name} is its hardest condition, with {format_percent(worst.success.rate)}")
    return "; ".join(parts) + "."


def eval_facts(result: EvalResult, factors: tuple[Factor, ...]) -> list[str]:
    """What else can be said in a sentence each."""
    facts = [_phase_fact(result), _condition_fact(result), _factor_fact(factors), _end_fact(result)]
    return [fact for fact in facts if fact]


def main_phase(result: EvalResult) -> tuple[str, int] | None:
    """Return the phase that most failures ended in, and how many; None where none failed or no phase is known."""
    known = {phase: count for phase, count in result.failures.items() if phase}
    return next(iter(known.items()), None)


def _phase_fact(result: EvalResult) -> str:
    phase = main_phase(result)
    if phase is None:
        return "" if result.success.successes == result.success.n else f"The phase of failures is {NOT_TOLD}."
    words = phase_words(phase[0], result.task)
    return f"{_named(phase[0]).capitalize()}, where failures end most often: {words}." if words else ""


def _condition_fact(result: EvalResult) -> str:
    worst = hardest(result)
    if worst is None or result.success.successes in (0, result.success.n):
        return ""
    count = len(by_condition(result))
    if worst.shown:
        return (
            f"Of {count} conditions {worst.name} is the hardest: {worst.success} of {worst.success.n:,} episodes, "
            f"against all others {format_p(worst.p_value)} (Fisher's exact test, corrected for the choice)."
        )
    return f"No condition of the {count} is shown to be harder than the others."


def _factor_fact(factors: tuple[Factor, ...]) -> str:
    if not factors or not factors[0].shown:
        return ""
    first = factors[0]
    worst = first.groups[first.worst]
    best = max(first.groups, key=lambda group: group.success.rate)
    names = dict(zip(first.groups, first.group_names, strict=True))
    return (
        f"Failures are associated most with {first.name}. "
        f"{format_percent(worst.success.rate)} succeed in its {names[worst]} "
        f"({worst.low:.3g} to {worst.high:.3g}), {format_percent(best.success.rate)} in its {names[best]}, "
        f"corrected {format_p(first.corrected)}."
    )


def _end_fact(result: EvalResult) -> str:
    lost = sum(episode.success and not episode.success_at_end for episode in result.episodes)
    if not lost:
        return ""
    return f"{lost:,} of the episodes that succeeded were no longer at the goal in their last frame."


def _named(phase: str) -> str:
    return phase.replace("_", " ")
