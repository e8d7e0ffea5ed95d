"""One evaluation as a table: all episodes, and each condition where there are several."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from manip_il.evaluation.results import EpisodeResult, EvalResult
from manip_il.evaluation.statistics import Proportion
from manip_il.evaluation.tables import Cells


def evaluation_table(result: EvalResult) -> Cells:
    """Return rows of success with its interval, success at the end, and control steps until success."""
    head = (f"success [{100 * result.confidence:g} % interval]", "success at end", "steps to success")
    return Cells(("policy", "episodes", *head), tuple(_rows(result)))


def evaluation_lines(result: EvalResult) -> list[str]:
    """What else is to be said of an evaluation: where its failures ended."""
    if not result.failures:
        return []
    phases = ", ".join(f"{phase} {count}" for phase, count in result.failures.items())
    return [f"failures by the phase that they ended in: {phases}"]


def _rows(result: EvalResult) -> Iterator[tuple[str, ...]]:
    yield _row(result.policy, result.episodes, result)
    if len(result.by_condition) > 1:
        for name in result.by_condition:
            yield _row(f"  {name}", [one for one in result.episodes if one.detail.get("condition") == name], result)


def _row(name: str, episodes: Sequence[EpisodeResult], result: EvalResult) -> tuple[str, ...]:
    steps = [one.detail.get("steps_to_success") for one in episodes if one.success]
    known = [float(count) for count in steps if count is not None]
    sequential = result.until_width is not None
    success, at_end = (
        str(Proportion.of(outcomes, result.confidence, sequential))
        for outcomes in ([one.success for one in episodes], [one.success_at_end for one in episodes])
    )
    return name, f"{len(episodes):,}", success, at_end, f"{sum(known) / len(known):.1f}" if known else ""
