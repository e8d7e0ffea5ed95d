"""The page of `manip-il reward fit`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from manip_il.evaluation.figures import CLONING, DAGGER, RULE, Figure, drawing, to_figure
from manip_il.evaluation.intervals import format_percent
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.learn.preference.fitting import BY_CHANCE
from manip_il.preferences.answers import Answers
from manip_il.preferences.fitting import TIE, Bin, Fitted
from manip_il.preferences.pairs import Clips

_MODEL = (
    f"P(left is better) = {1 - BY_CHANCE:g} sigmoid(R(left) - R(right)) + {BY_CHANCE / 2:g}",
    "R(clip) = Σ r(state, action)",
)


def agreement_table(found: Fitted) -> Table:
    """Return with what the reward agrees on held-out pairs, and how far the answers do themselves."""
    rows = [("answers", found.answered, "left or right was answered, and the reward says so")]
    if found.true is not None:
        rows.append(("true progress", found.true, f"ties left out, by less than {TIE:g}: {found.ties}"))
    if found.teachers is not None:
        rows.append(("the answers themselves with true progress", found.teachers, ""))
    cells = tuple((name, str(p), f"{p.n:,}", note) for name, p, note in rows)
    return Table(("with", "agreement", "of", "note"), cells).filled()


def calibration_table(bins: Sequence[Bin]) -> Table:
    """Return what was foretold beside what was answered, one row a range of probabilities."""
    rows = tuple((f"{b.low:.1f} to {b.high:.1f}", f"{b.foretold:.2f}", str(b.given), f"{b.given.n:,}") for b in bins)
    return Table(("foretold", "mean", "answered so", "of"), rows)


def calibration_figure(bins: Sequence[Bin]) -> Figure:
    """Draw how often the likelier clip was preferred over how likely it was foretold to be."""
    with drawing(1, size=(6.8, 2.8)) as (drawn, axes):
        axis = axes[0, 0]
        axis.plot([0.5, 1], [0.5, 1], "--", color=RULE, lw=1.5)
        x, y = [b.foretold for b in bins], [b.given.rate for b in bins]
        low, high = zip(*(b.given.interval for b in bins), strict=True) if bins else ((), ())
        axis.vlines(x, low, high, color=CLONING, lw=1.2, alpha=0.7)
        axis.plot(x, y, "o", color=DAGGER, ms=6)
        axis.set(xlim=(0.48, 1.0), ylim=(0.0, 1.02), xlabel="foretold", ylabel="answered so")
        return to_figure(drawn, "How often the likelier clip was preferred, over its foretold probability")


def summary_lines(found: Fitted, answers: Answers) -> list[str]:
    """Return what was learnt as plain lines."""
    told = f"{len(answers.better):,} answers about {len(set(answers.pair.tolist())):,} pairs"
    lines = [f"{told}, {answers.skipped:,} skipped, {answers.contradictory:,} pairs with contradictory answers"]
    lines.append(f"agreement with answers on held-out pairs: {found.answered}")
    if found.true is not None:
        lines.append(f"agreement with true progress on held-out pairs: {found.true} of {found.true.n:,}")
    return lines


def fit_report(
    found: Fitted,
    clips: Clips,
    answers: Answers,
    who: Sequence[str],
    command: str,
    config: Mapping[str, Any],
    timings: Mapping[str, float],
) -> Report:
    """Return the report of a reward. who: answered, one name a file."""
    sources = tuple((source.root, f"{source.episodes:,}", f"{source.frames:,}") for source in clips.pairs.sources)
    first, *facts = summary_lines(found, answers)
    best = found.true or found.answered
    return Report(
        title=f"A reward from preferences, {clips.pairs.robot} {clips.pairs.task}",
        verdict=f"On pairs that it did not learn from, the reward agrees with "
        f"{'true progress' if found.true is not None else 'the answers'} in {format_percent(best.rate)} of {best.n:,}.",
        facts=(f"{first}, by {', '.join(who)}.", *(f"{fact[:1].upper()}{fact[1:]}." for fact in facts)),
        command=command,
        config=config,
        timings=timings,
        sections=(
            Section(
                "Agreement",
                formulas=_MODEL,
                tables=(agreement_table(found),),
                notes=(
                    f"{found.shape.members} networks of {found.shape.depth} x {found.shape.width}; the pairs are dealt "
                    "into as many folds. Each network leaves one fold out, from which its numbers above are; all "
                    f"stopped at epoch {found.fit.epochs}, where the loss on these was lowest. The reward is their "
                    "mean, which has seen every pair.",
                ),
            ),
            Section(
                "Calibration",
                figures=(calibration_figure(found.bins),),
                tables=(calibration_table(found.bins),),
                notes=(
                    f"Of held-out answers left or right, by the probability of the clip that was likelier to be "
                    f"preferred. Mean square of answer minus probability: {found.brier:.3f}.",
                ),
            ),
            Section("Where the clips are from", tables=(Table(("dataset", "episodes", "frames"), sources),)),
        ),
    )
