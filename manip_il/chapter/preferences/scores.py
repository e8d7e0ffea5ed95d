"""Scores of a dataset's frames and episodes by a reward, and the file of sample weights for
LeRobot's RA-BC.

RA-BC learns from frames after which progress rises. A frame's own score does not tell whether to
learn from it, because failing episodes also approach the goal at first. The score at the episode's
end does, so the progress written is

    progress_t = t (score of the episode - bar)
    bar = upper quartile of the episodes' scores - BELOW

It rises throughout an episode that ends near the best quarter, and falls throughout the others.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.chapter.preferences.pairs import Frames
from manip_il.data.atomic import writing
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.evaluation.report import Table
from manip_il.mdp import F64

FILE_NAME, WEIGHTS_FILE = "scores.json", "rabc.parquet"
LAST = 1.0  # an episode's score is the mean over its last second [s]
# quantile of the episodes' scores, and how far below it the score of a kept episode may be
BEST, BELOW = 0.75, 0.25
WORST = 10  # number of episodes listed
_METADATA = b"reward_model_path"  # the key that LeRobot's own scripts write


@dataclass(frozen=True, eq=False)
class Scores:
    """Scores of a dataset.

    An episode's score is the mean over its last second: how close to success it ended.

    Attributes:
        root: Folder of the dataset.
        reward: Name of the reward.
        data: Frames of the dataset.
        frames: Score of each frame, 0 to 1, (N,).
    """

    root: str
    reward: str
    data: Frames
    frames: F64

    @cached_property
    def episodes(self) -> F64:
        """Score of each episode, the mean over its last `LAST` seconds, (E,)."""
        last = max(1, round(LAST * self.data.spec.fps))
        ends = self.data.firsts + self.data.lengths
        begins = np.maximum(self.data.firsts, ends - last)
        sums = np.concatenate([[0.0], np.cumsum(self.frames)])
        return (sums[ends] - sums[begins]) / (ends - begins)

    @property
    def bar(self) -> float:
        """Score up to which an episode's frames have no weight: the episodes' upper quartile
        minus `BELOW`.
        """
        return float(np.quantile(self.episodes, BEST)) - BELOW

    @property
    def succeeded(self) -> NDArray[np.bool_]:
        """Whether each episode succeeded at some step, (E,)."""
        return np.logical_or.reduceat(self.data.success, self.data.firsts)

    def to_json(self) -> dict[str, Any]:
        """Return the content of `scores.json`; frames' scores are in the parquet file."""
        succeeded, bar = self.succeeded, self.bar
        numbers = self.data.episodes[self.data.firsts].tolist()
        episodes: list[Mapping[str, Any]] = [
            {
                "episode": number,
                "frames": int(self.data.lengths[place]),
                "score": float(self.episodes[place]),
                "kept": bool(self.episodes[place] > bar),
                "success": bool(succeeded[place]),
            }
            for place, number in enumerate(numbers)
        ]
        return {
            "dataset": self.root,
            "reward": self.reward,
            "bar": bar,
            "episodes": episodes,
        }


def write_weights(path: Path, scores: Scores) -> None:
    """Write the columns that LeRobot's RA-BC reads: `index`, `episode_index`, `frame_index`,
    `progress_sparse`.

    RA-BC ignores the additional column `score`. Raises `ManipError` if the disk is full or
    read-only.
    """
    data = scores.data
    steps = np.arange(len(scores.frames)) - np.repeat(data.firsts, data.lengths)
    above = np.repeat(scores.episodes - scores.bar, data.lengths)
    table = pa.table(
        {
            "index": np.arange(len(scores.frames), dtype=np.int64),
            EPISODE_INDEX: data.episodes,
            "frame_index": steps,
            "progress_sparse": (steps * above).astype(np.float32),
            "score": scores.frames.astype(np.float32),
        },
        metadata={_METADATA: scores.reward.encode()},
    )
    with writing(path):
        pq.write_table(table, path)


def worst_table(scores: Scores) -> Table:
    """Return a table of the episodes with the lowest scores, lowest first."""
    data, succeeded = scores.data, scores.succeeded
    rows = tuple(
        (
            str(data.episodes[data.firsts[place]]),
            f"{scores.episodes[place]:.2f}",
            "yes" if succeeded[place] else "no",
            f"{data.lengths[place]:,}",
        )
        for place in np.argsort(scores.episodes, kind="stable")[:WORST].tolist()
    )
    return Table(("episode", "score", "success", "frames"), rows).filled()


def fact_lines(scores: Scores) -> list[str]:
    """Return a line that says how many episodes are kept."""
    kept, count = int((scores.episodes > scores.bar).sum()), len(scores.episodes)
    return [
        f"{kept:,} of {count:,} episodes score more than {scores.bar:.2f}; frames of the others"
        " have weight 0"
    ]
