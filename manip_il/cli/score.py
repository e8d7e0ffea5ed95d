"""`manip-il data score DATASET`: how good every frame and episode is, by a learnt reward or by true progress."""

from __future__ import annotations

import time
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.inputs import require_dataset, require_folder
from manip_il.cli.options import command_line, to_plain
from manip_il.cli.outputs import open_output, require_new
from manip_il.cli.preferences import load_reward
from manip_il.cli.progress import say
from manip_il.option import option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from manip_il.preferences.frames import Frames

PROGRESS = "progress"


@dataclass
class ScoreOptions:
    """Score every frame and episode of a dataset by a reward, and list the worst episodes.

    Writes scores.json, report.html, and rabc.parquet: weights of frames, for manip-il train --weights= and for
    lerobot-train --sample_weighting.progress_path=. Where the dataset says which episodes failed, how well the score
    finds them stands beside what true progress would find.
    """

    example: ClassVar[str] = "manip-il data score datasets/demos --reward=runs/reward --output_dir=runs/scores"
    dataset: Path = option(MISSING, "the dataset's folder", positional=True)
    reward: str = option(MISSING, "folder of manip-il preferences fit; progress: true progress")
    output_dir: Path = option(Path("runs/scores"), "folder of the files")
    overwrite: bool = option(False, "replace an existing one")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_dataset(self.dataset)
        if self.reward != PROGRESS:
            require_folder(Path(self.reward), "a reward of manip-il preferences fit, or the word progress")
        require_new(self.output_dir, overwrite=self.overwrite)

    def run(self) -> None:
        """Score, print the worst episodes, write the files."""
        from manip_il.evaluation.results import write_json
        from manip_il.evaluation.tables import print_table
        from manip_il.preferences.frames import read_frames
        from manip_il.preferences.scores import (
            FILE_NAME,
            WEIGHTS_FILE,
            Scores,
            fact_lines,
            score_report,
            worst_table,
            write_weights,
        )

        begin, data = time.monotonic(), read_frames(self.dataset)
        scores = Scores(str(self.dataset), self.reward, data, self._scores(data))
        timings = {"scoring": time.monotonic() - begin}
        with open_output(self) as folder:
            write_json(folder / FILE_NAME, scores.to_json())
            write_weights(folder / WEIGHTS_FILE, scores)
            page = folder / "report.html"
            score_report(scores, command_line("data score", self), to_plain(self), timings).write(page)
        print_table(worst_table(scores))
        for line in fact_lines(scores):
            say(line)
        say(f"report: {page}")
        weights = f"--weights={folder / WEIGHTS_FILE}"
        say(f"next: manip-il train --dataset.root={self.dataset} {weights} --output_dir=runs/weighted")

    def _scores(self, data: Frames) -> NDArray[np.float64]:
        """Score of every frame, (N,)."""
        import numpy as np

        from manip_il.errors import ManipError

        if self.reward == PROGRESS:
            if data.progress is None:
                raise ManipError(f"{self.dataset} has no column progress; give --reward=FOLDER")
            return data.progress
        reward = load_reward(Path(self.reward))
        reward.check_fits(str(self.dataset), data.spec)
        return np.clip(reward.of_inputs(data.inputs).astype(np.float64), 0.0, 1.0)
