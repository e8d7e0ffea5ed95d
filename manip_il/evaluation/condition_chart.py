"""Success by condition: of one policy with its intervals, of two as pairs; and which condition is the hardest."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from manip_il.evaluation import sections
from manip_il.evaluation.charts import success_bar
from manip_il.evaluation.comparison import Comparison
from manip_il.evaluation.episode_facts import by_condition, condition_of
from manip_il.evaluation.factors import fisher_exact, holm
from manip_il.evaluation.over_seeds import sign_flip_exact
from manip_il.evaluation.report_data import Kind, PolicyRow, format_percent
from manip_il.evaluation.results import EvalResult
from manip_il.evaluation.statistics import Proportion, format_p
from manip_il.evaluation.tables import Cells

UNNAMED = "without a condition"


@dataclass(frozen=True)
class Hardest:
    """The condition with the lowest success. p_value: against all others, corrected for the choice (Holm)."""

    name: str
    success: Proportion
    p_value: float

    @property
    def shown(self) -> bool:
        """Whether it is harder by more than chance."""
        return self.p_value < 1 - self.success.confidence


def condition_rows(result: EvalResult, kind: Kind) -> list[PolicyRow]:
    """Return a row a condition, after one of all; of a single condition, that row alone."""
    parts = {
        name: PolicyRow.of(name or UNNAMED, replace(result, episodes=episodes), kind=kind)
        for name, episodes in by_condition(result).items()
    }
    if len(parts) == 1:
        return [PolicyRow.of(result.policy, result, kind=kind)]
    return [PolicyRow.of("all conditions", result, kind="baseline"), *parts.values()]


def success_bars(rows: Sequence[PolicyRow]) -> str:
    """Return a bar with its interval for every row."""
    return sections.bars([(row.name, success_bar(row), row.success.rate) for row in rows])


def condition_words(result: EvalResult) -> dict[str, str]:
    """Return condition -> what is drawn under it; empty where nothing is."""
    conditions = result.settings.conditions
    if not any(condition.ranges for condition in conditions):
        return {}
    return {
        condition.name: ", ".join(f"{name} {_range(*ends)}" for name, ends in condition.ranges.items()) or "nothing"
        for condition in conditions
    }


def hardest(result: EvalResult) -> Hardest | None:
    """Return none where there is one condition alone."""
    parts = {
        name or UNNAMED: replace(result, episodes=episodes).success for name, episodes in by_condition(result).items()
    }
    if len(parts) < 2:
        return None
    total = result.success
    tests = {
        name: fisher_exact((part.successes, total.successes - part.successes), (part.n, total.n - part.n))
        for name, part in parts.items()
    }
    corrected = dict(zip(tests, holm(list(tests.values())), strict=True))
    worst = min(parts, key=lambda name: parts[name].rate)
    return Hardest(worst, parts[worst], corrected[worst])


def paired_conditions(comparison: Comparison) -> Cells | None:
    """Return both arms by condition, all training seeds together; None where there is one condition alone.

    p: exact over test episodes as in `Comparison.p_value`, corrected for the number of conditions (Holm).
    """
    first = comparison.left.members[0].result
    conditions = {episode.seed: condition_of(episode) for episode in first.episodes}
    names = list(dict.fromkeys(conditions.values()))
    if len(names) < 2:
        return None
    left, right = (_outcomes(comparison, side) for side in ("left", "right"))
    margins = [[sum(right[s]) - sum(left[s]) for s in conditions if conditions[s] == name] for name in names]
    corrected = holm([sign_flip_exact(one) for one in margins])
    rows: list[tuple[str, ...]] = []
    for name, margin, p in zip(names, margins, corrected, strict=True):
        seeds = [seed for seed in conditions if conditions[seed] == name]
        rates = [_rate(side, seeds) for side in (left, right)]
        difference = f"{100 * (rates[1] - rates[0]):+.1f} points"
        rows.append((name or UNNAMED, f"{len(margin):,}", *map(format_percent, rates), difference, format_p(p)))
    return Cells(("condition", "episodes", *comparison.names, "difference", "corrected p"), tuple(rows))


def _outcomes(comparison: Comparison, side: str) -> dict[int, list[bool]]:
    """Test seed -> success, one a training seed."""
    arm = comparison.left if side == "left" else comparison.right
    found: dict[int, list[bool]] = {}
    for member in arm.members:
        for episode in member.result.episodes:
            found.setdefault(episode.seed, []).append(episode.success)
    return found


def _rate(outcomes: dict[int, list[bool]], seeds: Sequence[int]) -> float:
    flat = [success for seed in seeds for success in outcomes[seed]]
    return sum(flat) / len(flat)


def _range(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"
