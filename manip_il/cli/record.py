"""`manip-il record`: a dataset of the expert's demonstrations."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.cli.common_options import EngineOptions, Varied
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import Resumable
from manip_il.data.video_config import VideoConfig
from manip_il.option import Seeded, option
from manip_il.worlds.config import EnvConfig


@dataclass(frozen=True)
class DatasetGroup:
    """`--dataset.*`: the recorded dataset."""

    repo_id: str | None = option(None, "USER/NAME on the Hub; by default local/ROBOT_TASK", free=True)
    root: Path | None = option(None, "folder of the dataset; by default datasets/NAME", free=True)
    num_episodes: int = option(50, "number of successful episodes", at_least=1, grows=True)
    rgb_encoder: Given = given(VideoConfig)


@dataclass(frozen=True)
class RecordOptions(Varied, Seeded, EngineOptions, Resumable):
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is written to ROOT.journals at once; the dataset appears when all episodes are recorded.
    --resume=true continues a recording; --dataset.num_episodes may then be larger.

    Example: manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos
    """

    first: ClassVar[str] = "robot.type task.type dataset.root dataset.num_episodes cameras seed resume"
    env: Given = given(EnvConfig)
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
