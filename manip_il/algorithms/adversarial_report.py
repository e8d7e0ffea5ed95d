"""The page of `manip-il rl gail`, `airl` and `ppo`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.ticker import EngFormatter

from manip_il.algorithms.iterations import best_validation
from manip_il.evaluation.figures import ARMS, CLONING, DAGGER, Figure, drawing, to_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.evaluation.tables import PolicyRow, policy_table

Records = Sequence[Mapping[str, Any]]
_PANELS = (
    ("of the learner's rollouts", {"success": "success", "absorbing": "share of time after success"}),
    (
        "discriminator right about",
        {"discriminator_accuracy_expert": "expert", "discriminator_accuracy_learner": "learner"},
    ),
    ("return, learnt reward", {"return": "return"}),
    ("distance of an iteration [nats]", {"kl": "KL"}),
    ("log of the actions' spread", {"log_std": "mean over the action"}),
)


def adversarial_report(
    title: str, found: Mapping[int, EvalResult], records: Records, command: str, config: Mapping[str, Any]
) -> Report:
    """Return the report of a run. found: its validations by iteration, not none. records: lines of metrics.jsonl."""
    best, steps = best_validation(dict(found)), {record["iteration"]: record["steps"] for record in records}
    names = {number: _name(number, steps) for number in found}
    shown = sorted({min(found), best, max(found)})
    rows = [PolicyRow(names[number], found[number], colour=DAGGER if number else CLONING) for number in shown]
    facts = ["The best policy was chosen on these episodes, so they flatter it; measure it by manip-il eval."]
    if 0 in found and best:
        facts.insert(0, compare_results(found[0], found[best], (names[0], names[best])).verdict)
    sections = [Section("Policies on the validation's episodes", tables=(policy_table(rows),), notes=tuple(facts))]
    if records:
        figures = (_validation_figure(found, steps), _learning_figure(records))
        sections.append(Section("How it learnt", figures=figures, notes=("Over simulated control steps.",)))
    return Report(
        title=title,
        verdict=f"Best {names[best]}: validation success {found[best].success}.",
        command=command,
        config=config,
        fingerprint=found[best].fingerprint,
        sections=tuple(sections),
    )


def _name(number: int, steps: Mapping[int, int]) -> str:
    return f"after {steps[number]:,} steps" if steps.get(number) else "policy given" if not number else "last"


def _validation_figure(found: Mapping[int, EvalResult], steps: Mapping[int, int]) -> Figure:
    with drawing(1, size=(6.5, 2.4)) as (drawn, axes):
        axis = axes[0, 0]
        x = [steps.get(number, 0) for number in found]
        rates = [one.success for one in found.values()]
        low, high = ([abs(rate.rate - rate.interval[side]) for rate in rates] for side in (0, 1))
        axis.errorbar(x, [rate.rate for rate in rates], yerr=(low, high), color=DAGGER, marker="o", ms=4, lw=1.4)
        axis.set(title="validation success", ylim=(-0.02, 1.02), xlabel="steps")
        axis.xaxis.set_major_formatter(EngFormatter())
        return to_figure(drawn, "Validation success over simulated steps, with intervals")


def _learning_figure(records: Records) -> Figure:
    panels = [(title, lines) for title, lines in _PANELS if any(key in record for record in records for key in lines)]
    with drawing(-(-len(panels) // 2), 2, size=(2.6, 2.0)) as (drawn, axes):
        for axis, (title, lines) in zip(axes.ravel(), panels, strict=False):
            for colour, (key, label) in zip(ARMS, lines.items(), strict=False):
                points = [(record["steps"], record[key]) for record in records if record.get(key) is not None]
                axis.plot(*zip(*points, strict=True), color=colour, lw=1.2, label=label) if points else None
            axis.set(title=title)
            axis.xaxis.set_major_formatter(EngFormatter())
            if len(lines) > 1:
                axis.legend()
        for axis in axes.ravel()[len(panels) :]:
            axis.remove()
        return to_figure(drawn, "How the learner changed over simulated steps")
