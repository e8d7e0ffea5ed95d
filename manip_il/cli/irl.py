"""`manip-il irl DATASET`: the weights of a reward, learnt from demonstrations of `carry`."""

from __future__ import annotations

import time
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import ClassVar

from manip_il.cli.inputs import require_dataset
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import open_output, require_new
from manip_il.cli.progress import progress, say, warn
from manip_il.errors import UnknownName
from manip_il.option import option

METHODS = ("max_margin", "bayesian", "max_entropy")


@dataclass
class IrlOptions:
    """Learn what the demonstrations of a dataset of carry care about: the weights of a reward.

    Writes reward.json, which --task.reward takes, and report.html: the weights, and the cost over the table.
    """

    example: ClassVar[str] = "manip-il irl datasets/carry --method=bayesian --output_dir=runs/irl"
    dataset: Path = option(MISSING, "demonstrations of the task carry", positional=True)
    method: str = option("max_entropy", ", ".join(METHODS))
    seed: int = option(0, "of what is drawn at random")
    output_dir: Path = option(Path("runs/irl"), "folder of reward.json")
    overwrite: bool = option(False, "replace an existing one")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        from manip_il.seeding import stream_base  # here, as help needs no numpy

        if self.method not in METHODS:
            raise UnknownName("method", self.method, METHODS)
        stream_base("training", self.seed)
        require_dataset(self.dataset)
        require_new(self.output_dir, overwrite=self.overwrite)

    def run(self) -> None:
        """Read, learn, write the reward and the page, print the weights."""
        from manip_il.algorithms.inverse import read_carried
        from manip_il.algorithms.inverse_report import (
            FILE_NAME,
            PAGE,
            Inverse,
            inverse_report,
            open_line,
            summary_lines,
        )
        from manip_il.data.dataset import Dataset
        from manip_il.evaluation.results import write_json
        from manip_il.rewards.methods import learn
        from manip_il.seeding import rng_for, stream_base

        info, begin, timings = Dataset.open(self.dataset).summary, time.monotonic(), dict[str, float]()
        with progress(info.episodes, f"irl {self.dataset}") as bar:
            carried = read_carried(self.dataset, bar.advance)
        timings["reading"] = time.monotonic() - begin
        begin, rng = time.monotonic(), rng_for(stream_base("training", self.seed), "irl")
        learnt = learn(self.method, [one.demonstration for one in carried], rng)
        timings["learning"] = time.monotonic() - begin
        found = Inverse(str(self.dataset), tuple(carried), learnt)
        with open_output(self) as folder:
            write_json(folder / FILE_NAME, found.to_json())
            inverse_report(found, command_line("irl", self), to_plain(self), timings).write(folder / PAGE)
        for line in summary_lines(found):
            say(line)
        if line := open_line(found):
            warn(line)
        say(f"report: {folder / PAGE}")
        robot = "" if info.robot == "panda" else f"--robot.type={info.robot} "
        say(f"next: manip-il eval --policy.type=expert {robot}--task.type=carry --task.reward={folder / FILE_NAME}")
