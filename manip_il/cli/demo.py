"""`manip-il demo`: demonstrations, cloning, DAgger, and a report that compares them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.algorithms.config import RunConfig
from manip_il.cli.common_options import EngineOptions
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.learn.fit_config import FitConfig
from manip_il.option import option
from manip_il.worlds.config import EnvConfig

RUN: Given = {"demonstrations": 100, "rounds": 3, "validation_episodes": 100}  # replace the defaults of dagger
FIT: Given = {"steps": 3_000, "batch_size": 256}


@dataclass(frozen=True)
class DemoOptions(EngineOptions, ResumableOutput):
    """Run a small complete example: the expert demonstrates, a policy is cloned, DAgger improves it.

    Compares the expert, the cloned policy, a policy cloned from as many labels as DAgger used, and DAgger's best round
    on the same unseen seeds, undisturbed and disturbed; OUTPUT_DIR/report.html shows the result. The policies are mlps;
    for other kinds use manip-il train and manip-il dagger.

    Example: manip-il demo --output_dir=runs/demo
    """

    first: ClassVar[str] = "robot.type task.type rounds test_episodes output_dir resume"
    env: Given = given(EnvConfig)
    settings: Given = given(RunConfig, prefix="", only=(*RUN, "episodes_per_round", "disturbed_share", "seed"), **RUN)
    fit: Given = given(FitConfig, prefix="", only=("policy", *FIT), fixed=("steps",), **FIT)
    test_episodes: int = option(200, "unseen test episodes, which never select a policy", at_least=1)
    disturbed_episodes: int = option(100, "test episodes that are also run with disturbances", at_least=1)
    output_dir: Path = output_folder("runs/demo")
