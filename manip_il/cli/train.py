"""`manip-il train`: behaviour cloning on datasets, with our policies and LeRobot's."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.common_options import DatasetRoots, Trusting
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.option import Seeded, option

RANK = "RANK"  # environment variable with the process's index in distributed training


@dataclass(frozen=True)
class SourceGroup(DatasetRoots):
    """`--dataset.*`: the training data and its weights."""

    weights: list[float] = option(list, "share of the samples from each dataset; by default its share of frames")

    def __post_init__(self) -> None:
        wrong = not all(0 < weight < math.inf for weight in self.weights)
        if self.weights and (wrong or len(self.weights) != len(self.root)):
            found = f"{self.weights} for {len(self.root)} datasets"
            raise UsageError(f"--dataset.weights is {found}; expected a number above 0 for each")


@dataclass(frozen=True)
class TrainOptions(Seeded, Trusting, ResumableOutput):
    """Fit a policy to the labels of one or more datasets of one robot (behaviour cloning).

    --policy.type is mlp, cnn or any LeRobot policy (act, diffusion, vqbet, ...); its options have LeRobot's names:
    manip-il train --policy.type=act --help lists them. OUTPUT_DIR/checkpoints/last/pretrained_model is a LeRobot
    checkpoint.

    Example: manip-il train --dataset.root=datasets/demos --policy.type=act --observation=state
    --output_dir=runs/act
    """

    first: ClassVar[str] = "dataset.root policy observation action_space steps batch_size output_dir resume"
    dataset: SourceGroup
    weights: Path | None = option(
        None, "rabc.parquet from manip-il data score: sampling weights of frames, as in LeRobot's RA-BC", exists=""
    )
    fit: Given = given(FitConfig, prefix="")
    output_dir: Path = output_folder("runs/train")
