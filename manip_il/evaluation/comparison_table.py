"""A comparison on a terminal: which round of which run was taken, what it had cost, and how it did."""

from __future__ import annotations

from collections.abc import Sequence

from manip_il.evaluation.comparison import Comparison, Measured
from manip_il.evaluation.report_data import Cost, format_amount, format_seconds
from manip_il.evaluation.rounds import END, Round, Rule
from manip_il.evaluation.statistics import PairedComparison, format_p
from manip_il.evaluation.tables import Cells

UNEQUAL = 1.05  # costs that differ by a larger factor are said not to be equal


def comparison_table(comparison: Comparison) -> Cells:
    """Return two rows a training seed, the paired result on the second."""
    confidence = f"{100 * comparison.confidence:g} %"
    columns = ("policy", "training seed", "round", "labels", "episodes", "wall-clock", "validation")
    columns += (f"test [{confidence} interval]", "difference", "McNemar's exact p")
    rows: list[tuple[str, ...]] = []
    members = zip(comparison.left.members, comparison.right.members, comparison.pairs, strict=True)
    for left, right, pair in members:
        rows += [(*_row(left), "", ""), (*_row(right), *_paired(pair))]
    return Cells(columns, tuple(rows))


def comparison_facts(comparison: Comparison, rule: Rule, limit: float | None) -> list[str]:
    """Sentences: the rule by which rounds were taken, and what the numbers over training seeds mean."""
    members = (*comparison.left.members, *comparison.right.members)
    rounds = [member.chosen for member in members if member.chosen is not None]
    facts = rule_facts(rule, limit, rounds) if rounds else []
    if len(comparison.pairs) > 1:
        facts.append(over_seeds_fact(len(comparison.pairs)))
    return facts


def rule_facts(rule: Rule, limit: float | None, rounds: Sequence[Round]) -> list[str]:
    """Which rounds were taken, and whether what they had cost was the same."""
    if rule.axis == END or limit is None:
        return [f"{rule.words}."]
    whence = "given" if rule.amount is not None else "the most that every run reached"
    facts = [f"{rule.words}, within {format_amount(rule.axis, limit)} ({whence})."]
    if unequal := _unequal(rule.axis, rounds):
        facts.append(unequal)
    return facts


def over_seeds_fact(count: int) -> str:
    """What the interval and the test over training seeds are."""
    return (
        f"The interval is Student's over {count} training seeds; with so few it is wide. "
        "p is exact over test episodes, which flip together for all training seeds, and holds for these policies alone."
    )


def _unequal(axis: Cost, rounds: Sequence[Round]) -> str:
    amounts = [one.amount(axis) for one in rounds]
    low, high = min(amounts), max(amounts)
    if high <= UNEQUAL * low:
        return ""
    spent = f"{format_amount(axis, low).removesuffix(f' {axis}')} to {format_amount(axis, high)}"
    return (
        f"The rounds taken had used {spent}: the best one may come early, and a round that would have gone over the "
        "limit does not count."
    )


def _row(member: Measured) -> tuple[str, ...]:
    seed = "" if member.training_seed is None else str(member.training_seed)
    return (member.name, seed, *_round(member.chosen), str(member.result.success))


def _round(chosen: Round | None) -> tuple[str, ...]:
    if chosen is None:
        return ("",) * 5
    amounts = (f"{chosen.labels:,}", f"{chosen.episodes:,}", format_seconds(chosen.seconds))
    return (str(chosen.round), *amounts, f"{100 * chosen.validation.rate:.1f} %")


def _paired(pair: PairedComparison) -> tuple[str, str]:
    low, high = pair.interval
    p = format_p(pair.p_value).removeprefix("p ").removeprefix("= ")
    return f"{100 * pair.difference:+.1f} points [{100 * low:+.1f}, {100 * high:+.1f}]", p
