"""The page of `manip-il rl gail`, `airl` and `ppo`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from matplotlib.ticker import EngFormatter

from manip_il.algorithms.learning_run import best_validation
from manip_il.evaluation.figures import ARMS, CLONING, DAGGER, Figure, drawing, to_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.results import EvalResult, compare_results
from manip_il.evaluation.tables import PolicyRow, policy_table

Records = Sequence[Mapping[str, Any]]
_PANELS = {
    "validation": {"validation_success": "success"},
    "of the learner's rollouts": {"success": "success", "absorbing": "share of time after success"},
    "discriminator right about": {
        "discriminator_accuracy_expert": "expert",
        "discriminator_accuracy_learner": "learner",
    },
    "return, learnt reward": {"return": "return"},
    "distance of an iteration [nats]": {"kl": "KL"},
    "log of the actions' spread": {"log_std": "mean over the action"},
}


def adversarial_report(
    title: str, found: Mapping[int, EvalResult], records: Records, command: str, config: Mapping[str, Any]
) -> Report:
    """Return the report of a run. found: its validations by iteration, not none. records: lines of metrics.jsonl."""
    best, steps = best_validation(dict(found)), {record["iteration"]: record["steps"] for record in records}
    names = {
        number: f"after {steps[number]:,} steps" if steps.get(number) else "last" if number else "policy given"
        for number in found
    }
    shown = sorted({min(found), best, max(found)})
    rows = [PolicyRow(names[number], found[number], colour=DAGGER if number else CLONING) for number in shown]
    facts = ["The best policy was chosen on these episodes, so they flatter it; measure it by manip-il eval."]
    if 0 in found and best:
        facts.insert(0, compare_results(found[0], found[best], (names[0], names[best])).verdict)
    sections = [Section("Policies on the validation's episodes", tables=(policy_table(rows),), notes=tuple(facts))]
    if records:
        notes = ("Over simulated control steps.",)
        sections.append(Section("How it learnt", figures=(_learning_figure(records),), notes=notes))
    return Report(
        title=title,
        verdict=f"Best {names[best]}: validation success {found[best].success}.",
        command=command,
        config=config,
        fingerprint=found[best].fingerprint,
        sections=tuple(sections),
    )


def _learning_figure(records: Records) -> Figure:
    panels = {title: lines for title, lines in _PANELS.items() if any(key in one for one in records for key in lines)}
    with drawing(-(-len(panels) // 2), 2, size=(2.6, 2.0)) as (drawn, axes):
        for axis, (title, lines) in zip(axes.ravel(), panels.items(), strict=False):
            for colour, (key, label) in zip(ARMS, lines.items(), strict=False):
                points = [(record["steps"], record[key]) for record in records if record.get(key) is not None]
                axis.plot(*zip(*points, strict=True), color=colour, marker=".", lw=1.2, label=label) if points else None
            axis.set(title=title)
            axis.xaxis.set_major_formatter(EngFormatter())
            if len(lines) > 1:
                axis.legend()
        for axis in axes.ravel()[len(panels) :]:
            axis.remove()
        return to_figure(drawn, "How the learner changed over simulated steps")
