"""The page of `manip-il rl gail`, `airl` and `ppo`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from manip_il.algorithms.learning_run import best_validation
from manip_il.evaluation.eval_report import run_report
from manip_il.evaluation.figures import CLONING, DAGGER, Curve
from manip_il.evaluation.report import Report
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.evaluation.rounds import history
from manip_il.evaluation.tables import PolicyRow


def adversarial_report(
    title: str,
    found: Mapping[int, EvalResult],
    records: Sequence[Mapping[str, Any]],
    command: str,
    config: Mapping[str, Any],
) -> Report:
    """Return the report of a run. found: its validations by iteration, not none. records: lines of metrics.jsonl."""
    best, steps = best_validation(dict(found)), {record["iteration"]: record["steps"] for record in records}
    names = {
        number: f"after {steps[number]:,} steps" if steps.get(number) else "last" if number else "policy given"
        for number in found
    }
    shown = sorted({min(found), best, max(found)})
    facts = ["The best policy was chosen on these episodes, so they flatter it; measure it by manip-il eval."]
    if 0 in found and best:
        facts.insert(0, compare_results(found[0], found[best], (names[0], names[best])).verdict)
    return run_report(
        [PolicyRow(names[number], found[number], colour=DAGGER if number else CLONING) for number in shown],
        curves=[Curve(title, (history(records, title),), costs=("steps", "seconds"))],
        title=title,
        verdict=f"Best {names[best]}: validation success {found[best].success}.",
        facts=tuple(facts),
        command=command,
        config=config,
        fingerprint=found[best].fingerprint,
    )
