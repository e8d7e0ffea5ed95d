"""`manip-il data check`, `repair`, `score`: find what is wrong with a dataset, repair it, find its bad episodes."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.inputs import REWARD, dataset_differences, exists, load_reward, require_dataset
from manip_il.cli.options import group
from manip_il.cli.outputs import Output
from manip_il.cli.progress import say
from manip_il.errors import ManipError
from manip_il.option import option

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from manip_il.data.dataset import Dataset
    from manip_il.doctor.finding import Finding
    from manip_il.preferences.frames import Frames

PROGRESS = "progress"  # in place of a reward


@dataclass
class CheckOptions:
    """Check any LeRobot v3.0 dataset: files, rows, video frames, statistics, and why a policy would not learn from it.

    One line per finding on standard output, with what to do; exit code 1 after errors, 0 after warnings alone.
    """

    example: ClassVar[str] = "manip-il data check datasets/demos"
    dataset: Path = option(
        MISSING, "folder of a LeRobot v3.0 dataset", positional=True, check=exists("the folder of a LeRobot dataset")
    )

    def run(self) -> None:
        """Examine, and say the verdict; raises `NotWhole` after errors."""
        root = _named(self.dataset)
        _say_verdict(root, _examine(root))


@dataclass
class RepairOptions:
    """Build a dataset again from its journals; without them compute counts and statistics, and move leftovers away.

    What it replaces is kept in DATASET.before-repair. Then the dataset is checked again.
    """

    example: ClassVar[str] = "manip-il data repair datasets/demos"
    dataset: Path = option(
        MISSING, "folder of a LeRobot v3.0 dataset", positional=True, check=exists("the folder of a LeRobot dataset")
    )

    def run(self) -> None:
        """Examine, repair, examine again, and say the verdict; raises `NotWhole` if something stays wrong."""
        from manip_il.doctor.examine import repair

        root = _named(self.dataset)
        if not (findings := _examine(root)):
            say("repair   nothing to repair")
        elif done := list(repair(root, findings)):
            for line in done:
                say(f"repair   {line}")
            findings = _examine(root)
        else:
            say("repair   nothing that can be repaired")
        _say_verdict(root, findings)


def _named(root: Path) -> Path:
    """Return the folder by its name: journals and copies beside it are named after it."""
    return root if root.name not in ("", "..") else root.resolve()


def _examine(root: Path) -> list[Finding]:
    """Examine a dataset and print every finding."""
    from manip_il.doctor.examine import examine_folder

    findings = examine_folder(root, [check_robot])
    for finding in findings:
        say(str(finding))
    return findings


def _say_verdict(root: Path, findings: list[Finding]) -> None:
    """Print how much is whole; raises `NotWhole` with the numbers after errors."""
    from manip_il.data.dataset import Dataset
    from manip_il.doctor.finding import NotWhole

    errors = sum(finding.is_error for finding in findings)
    numbers = {"error": errors, "warning": len(findings) - errors}
    counts = [f"{number} {name}{'' if number == 1 else 's'}" for name, number in numbers.items() if number]
    if errors:
        raise NotWhole(f"{root}: {', '.join(counts)}")
    dataset = Dataset.open(root)
    whole = f"{dataset.info.episodes:,} episodes, {dataset.info.frames:,} frames: whole"
    say(f"{root}: {', '.join([whole, *counts])}")


def check_robot(dataset: Dataset) -> Iterator[Finding]:
    """Compare joints, observations and compiled model with those of the robot and task in this program."""
    from manip_il.data.lerobot_layout import OURS
    from manip_il.doctor.finding import Finding, warning

    if (own := dataset.own) is None:
        return
    try:
        for text in dataset_differences("the dataset", own.spec, own.fingerprint):
            yield warning(OURS, text, f"if labels should be of today: manip-il data relabel {dataset.root}")
    except ManipError as error:
        yield Finding(OURS, str(error), "use the version of this program that recorded it, or record again")


@dataclass
class ScoreOptions:
    """Score every frame and episode of a dataset by a reward, and list the worst episodes.

    Writes scores.json and rabc.parquet: weights of frames, for manip-il train --weights= and for
    lerobot-train --sample_weighting.progress_path=. Where the dataset says which episodes failed, it says how well the
    score finds them.
    """

    example: ClassVar[str] = "manip-il data score datasets/demos --reward=runs/reward --output_dir=runs/scores"
    dataset: Path = option(MISSING, "the dataset's folder", positional=True, check=require_dataset)
    reward: str = option(MISSING, "folder of manip-il reward fit; progress: true progress")
    output: Output = group(Output(Path("runs/scores")), prefix="")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        if self.reward != PROGRESS:
            exists(f"{REWARD}, or the word progress")(Path(self.reward))
        self.output.check()

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
            worst_table,
            write_weights,
        )

        data = read_frames(self.dataset)
        scores = Scores(str(self.dataset), self.reward, data, self._scores(data))
        with self.output.open(self) as folder:
            write_json(folder / FILE_NAME, scores.to_json())
            write_weights(folder / WEIGHTS_FILE, scores)
        print_table(worst_table(scores))
        say(*fact_lines(scores))
        weights = f"--weights={folder / WEIGHTS_FILE}"
        say(f"next: manip-il train --dataset.root={self.dataset} {weights} --output_dir=runs/weighted")

    def _scores(self, data: Frames) -> NDArray[np.float64]:
        """Score of every frame, (N,)."""
        import numpy as np

        if self.reward == PROGRESS:
            if data.progress is None:
                raise ManipError(f"{self.dataset} has no column progress; give --reward=FOLDER")
            return data.progress
        reward = load_reward(Path(self.reward))
        reward.check_fits(str(self.dataset), data.spec)
        return np.clip(reward.of_inputs(data.inputs).astype(np.float64), 0.0, 1.0)
