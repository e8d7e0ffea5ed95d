"""The page and the lines of `manip-il data score`."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np

from manip_il.evaluation.figures import CLONING, DAGGER, EXPERT, Figure, drawing, to_figure
from manip_il.evaluation.report import Report, Section
from manip_il.evaluation.tables import Table
from manip_il.preferences.scores import BELOW, Scores, episode_scores

WORST = 10  # episodes that are listed
_SHOWN = 3  # of the worst and of the best, drawn over time


def worst_table(scores: Scores, count: int = WORST) -> Table:
    """Return the episodes with the lowest scores, lowest first."""
    data, every = scores.data, scores.episodes
    true = episode_scores(data.progress, data) if data.progress is not None else None
    succeeded = scores.succeeded
    rows = tuple(
        (
            str(data.episodes[data.firsts[place]]),
            f"{every[place]:.2f}",
            "" if true is None else f"{true[place]:.2f}",
            "" if succeeded is None else ("yes" if succeeded[place] else "no"),
            f"{data.lengths[place]:,}",
        )
        for place in scores.worst(count)
    )
    return Table(("episode", "score", "true progress", "success", "frames"), rows).filled()


def fact_lines(scores: Scores) -> list[str]:
    """Return which episodes are kept, how well the score finds failed ones, and how it follows true progress."""
    kept, count = int((scores.episodes > scores.bar).sum()), len(scores.episodes)
    lines = [f"{kept:,} of {count:,} episodes score more than {scores.bar:.2f}: the frames of the others weigh 0"]
    if scores.auc is not None:
        beside = "" if scores.true_auc is None else f", by true progress {scores.true_auc:.3f}"
        lines.append(f"area under the ROC curve of finding failed episodes: {scores.auc:.3f}{beside}")
    if scores.correlation is not None:
        lines.append(f"rank correlation of frames' scores with true progress: {scores.correlation:.3f}")
    return lines


def score_report(scores: Scores, command: str, config: Mapping[str, Any], timings: Mapping[str, float]) -> Report:
    """Return the report of a dataset's scores."""
    low = scores.worst(1)[0]
    episode = scores.data.episodes[scores.data.firsts[low]]
    return Report(
        title=f"Scores of {scores.root}",
        verdict=f"Of {len(scores.episodes):,} episodes, number {episode} has the lowest score: "
        f"{scores.episodes[low]:.2f}.",
        facts=(f"Scored by {scores.reward}.", *(f"{line[:1].upper()}{line[1:]}." for line in fact_lines(scores))),
        command=command,
        config=config,
        timings=timings,
        sections=(
            Section("The worst episodes", tables=(worst_table(scores),), notes=(_MEANING,)),
            Section("Over time", figures=(curves_figure(scores),), notes=("Of the worst and the best episodes.",)),
        ),
    )


_MEANING = (
    "An episode's score is the mean of its last second's frames. "
    f"One that is {BELOW:g} or more below the best quarter's has weight 0."
)


def curves_figure(scores: Scores) -> Figure:
    """Draw the scores of the worst and the best episodes over time, with true progress where there is some."""
    order = np.argsort(scores.episodes, kind="stable").tolist()
    kinds = (("worst", order[:_SHOWN], CLONING), ("best", order[-_SHOWN:], DAGGER))
    with drawing(2, size=(3.4, 2.6), share=True) as (drawn, axes):
        for axis, (title, places, colour) in zip(axes[0], kinds, strict=True):
            for place in places:
                rows = scores.data.rows(place)
                time = np.arange(rows.stop - rows.start) / scores.data.spec.fps
                axis.plot(time, scores.frames[rows], color=colour, lw=1.3, alpha=0.85)
                if scores.data.progress is not None:
                    axis.plot(time, scores.data.progress[rows], ":", color=EXPERT, lw=1.1)
            axis.set(title=f"{title} (dotted: true progress)" if scores.data.progress is not None else title)
            axis.set(xlabel="time [s]", ylim=(-0.05, 1.05))
        return to_figure(drawn, "Scores of the worst and of the best episodes over time")
