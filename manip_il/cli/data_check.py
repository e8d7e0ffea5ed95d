"""`manip-il data check`, `repair`: find errors in a dataset, and repair them."""

from __future__ import annotations

from dataclasses import MISSING, dataclass
from pathlib import Path

from manip_il.cli.common_options import OfDataset
from manip_il.cli.outputs import Output, output_folder
from manip_il.option import option


@dataclass(frozen=True)
class CheckOptions(OfDataset):
    """Check any LeRobot v3.0 dataset: files, rows, video frames, statistics, and whether a policy can learn from it.

    Prints one line per finding, with what to do. The exit code is 1 if there are errors, 0 if only warnings.

    Example: manip-il data check datasets/demos
    """


@dataclass(frozen=True)
class RepairOptions(CheckOptions):
    """Rebuild a dataset from its journals; without them recompute counts and statistics, and move leftover files away.

    Replaced files are kept in DATASET.before-repair. Then the dataset is checked again.

    Example: manip-il data repair datasets/demos
    """


@dataclass(frozen=True)
class ScoreOptions(OfDataset, Output):
    """Score every frame and episode of a dataset by a reward, and list the worst episodes.

    Writes scores.json, and rabc.parquet with the frames' weights for manip-il train --weights= and
    lerobot-train --sample_weighting.progress_path=. If the dataset says which episodes failed, also prints how well the
    score detects them.

    Example: manip-il data score datasets/demos --reward=runs/reward --output_dir=runs/scores
    """

    reward: str = option(MISSING, "a folder from manip-il reward fit, or progress for the true progress")
    output_dir: Path = output_folder("runs/scores")
