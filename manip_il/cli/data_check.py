"""`manip-il data check`, `repair`, `score`: find errors in a dataset, repair them, find bad episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.common_options import OfDataset
from manip_il.cli.options import group
from manip_il.cli.outputs import Output, publish
from manip_il.cli.progress import say
from manip_il.errors import ManipError
from manip_il.evaluation.policy_folder import find_policy
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.data.dataset import Dataset
    from manip_il.doctor.finding import Finding

PROGRESS = "progress"  # value of --reward: score by true progress


@dataclass(frozen=True)
class CheckOptions(OfDataset):
    """Check any LeRobot v3.0 dataset: files, rows, video frames, statistics, and whether a policy can learn from it.

    Prints one line per finding, with what to do. The exit code is 1 if there are errors, 0 if only warnings.
    """

    example: ClassVar[str] = "manip-il data check datasets/demos"

    def run(self) -> None:
        """Check the dataset and print every finding and the verdict; raises `NotWhole` if there are errors."""
        self._conclude(self._examine())

    def _examine(self, *, repaired: bool = False) -> list[Finding]:
        """Check the dataset and print every finding."""
        from manip_il.doctor.examine import examine_folder

        findings = examine_folder(self.dataset.absolute(), [check_robot], repaired=repaired)
        say(*map(str, findings))
        return findings

    def _conclude(self, findings: list[Finding]) -> None:
        from manip_il.data.dataset import Dataset
        from manip_il.doctor.finding import NotWhole

        errors = sum(finding.is_error for finding in findings)
        if errors:
            raise NotWhole(f"{self.dataset}: errors: {errors}, warnings: {len(findings) - errors}")
        info = Dataset.open(self.dataset).info
        say(f"{self.dataset}: {info.episodes:,} episodes, {info.frames:,} frames: whole; warnings: {len(findings)}")


@dataclass(frozen=True)
class RepairOptions(CheckOptions):
    """Rebuild a dataset from its journals; without them recompute counts and statistics, and move leftover files away.

    Replaced files are kept in DATASET.before-repair. Then the dataset is checked again.
    """

    example: ClassVar[str] = "manip-il data repair datasets/demos"

    def run(self) -> None:
        """Check, repair, check again, and print the verdict; raises `NotWhole` if errors remain."""
        from manip_il.doctor.examine import repair

        if findings := self._examine():
            say(*(f"repair   {line}" for line in repair(self.dataset.absolute(), findings)))
            findings = self._examine(repaired=True)
        self._conclude(findings)


def check_robot(dataset: Dataset) -> Iterator[Finding]:
    """Compare a dataset's joints, observations and model with those of its robot and task in this version."""
    from manip_il.cli.inputs import differences
    from manip_il.data.lerobot_layout import OURS
    from manip_il.doctor.finding import Finding, warning

    if dataset.own is None:
        return
    try:
        for text in differences(dataset):
            yield warning(OURS, text, f"for labels of the current expert: manip-il data relabel {dataset.root}")
    except ManipError as error:
        yield Finding(OURS, str(error), "use the version of this program that recorded it, or record again")


@dataclass(frozen=True)
class ScoreOptions(OfDataset):
    """Score every frame and episode of a dataset by a reward, and list the worst episodes.

    Writes scores.json, and rabc.parquet with the frames' weights for manip-il train --weights= and
    lerobot-train --sample_weighting.progress_path=. If the dataset says which episodes failed, also prints how well the
    score detects them.
    """

    example: ClassVar[str] = "manip-il data score datasets/demos --reward=runs/reward --output_dir=runs/scores"
    reward: str = option(MISSING, "a folder from manip-il reward fit, or progress for the true progress")
    output: Output = group(Output(Path("runs/scores")), prefix="")

    def run(self) -> None:
        """Score, print the worst episodes, write the files."""
        from manip_il.learn.reward import LearnedReward
        from manip_il.preferences import scores as scoring
        from manip_il.preferences.frames import read_frames

        data = read_frames(self.dataset)
        if self.reward != PROGRESS:
            reward = LearnedReward.load(find_policy(Path(self.reward).expanduser()))
            reward.check_fits(str(self.dataset), data.spec)
            found = reward.of_inputs(data.inputs).astype("float64").clip(0.0, 1.0)
        elif data.progress is not None:
            found = data.progress
        else:
            raise ManipError(f"{self.dataset} has no progress column; give --reward=FOLDER")
        scores = scoring.Scores(str(self.dataset), self.reward, data, found)
        with self.output.open(self, Path(self.reward).expanduser()) as folder:
            scoring.write_weights(folder / scoring.WEIGHTS_FILE, scores)
            worst = [scoring.worst_table(scores)]
            publish(folder / scoring.FILE_NAME, scores.to_json(), worst, *scoring.fact_lines(scores))
