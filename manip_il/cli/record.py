"""`manip-il record`: demonstrations of the expert, as a LeRobot dataset."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli.folders import prepare_output
from manip_il.cli.groups import EnvGroup, RobotGroup, TaskGroup, check_same_options, option, save_options, warn
from manip_il.cli.progress import say
from manip_il.errors import ManipError, UsageError

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob

HOLD = 10  # control steps that a demonstration goes on for after success
_REPO_ID = re.compile(r"[\w.-]+/[\w.-]+")


@dataclass
class DatasetGroup:
    """`--dataset.*` of what is recorded."""

    repo_id: str | None = option(None, "USER/NAME on the Hub; by default local/ROBOT_TASK")
    root: Path | None = field(default=None, metadata={"help": "folder of the dataset; by default datasets/NAME"})
    num_episodes: int = option(50, "successful episodes")


@dataclass
class RecordOptions:
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is on disk at once, in ROOT.journals; the dataset appears when all are there.
    """

    example: ClassVar[str] = "manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos"
    robot: RobotGroup = field(default_factory=RobotGroup)
    task: TaskGroup = field(default_factory=TaskGroup)
    env: EnvGroup = field(default_factory=EnvGroup)
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
    cameras: list[str] = field(default_factory=list, metadata={"help": "cameras to record"})
    seed: int = option(0, "shifts every random stream, 0 to 1000")
    workers: int | None = option(None, "processes; by default one a core")
    resume: bool = option(False, "go on with a recording, also to more episodes")
    overwrite: bool = option(False, "replace a dataset that is there")

    def run(self) -> None:
        """Record, then write the dataset."""
        self._check()
        env = self.env.config(self.robot.type, self.task.type)
        from manip_il.engine.jobs import RolloutJob

        root, journals = self._folders()
        prepare_output(root, resume=self.resume, overwrite=self.overwrite)
        prepare_output(journals, resume=self.resume, overwrite=self.overwrite)
        if self._is_there(root, journals):
            say(f"{root} holds its {self.dataset.num_episodes} episodes already")
        else:
            job = RolloutJob(env, "expert", beta=1.0, hold=HOLD)
            self._record(job, root, journals)
        say(f"next: manip-il train --dataset.root={root} --output_dir=runs/{root.name}")

    def _check(self) -> None:
        if self.cameras:
            raise UsageError(
                f"--cameras={','.join(self.cameras)}: this version records no pictures; leave --cameras out "
                "(the column sim_state is kept, so that pictures can be made later)"
            )
        if self.dataset.num_episodes < 1:
            raise UsageError(f"--dataset.num_episodes is {self.dataset.num_episodes}; expected at least 1")
        if not _REPO_ID.fullmatch(self._repo_id()):
            raise UsageError(f"--dataset.repo_id is {self._repo_id()!r}; expected USER/NAME")

    def _repo_id(self) -> str:
        return self.dataset.repo_id or f"local/{self.robot.type}_{self.task.type}"

    def _folders(self) -> tuple[Path, Path]:
        root = self.dataset.root or Path("datasets") / self._repo_id().partition("/")[2]
        return root, root.with_name(f"{root.name}.journals")

    def _is_there(self, root: Path, journals: Path) -> bool:
        """Whether a resumed recording has nothing to do; a smaller dataset is removed, its journals hold it all."""
        from manip_il.data.lerobot_io import dataset_info

        if not self.resume:
            return False
        free = ("workers", "dataset.root", "dataset.repo_id")
        check_same_options(journals, self, free, may_grow="dataset.num_episodes")
        if not root.is_dir() or not any(root.iterdir()):
            return False
        if not journals.is_dir():
            raise ManipError(f"no {journals} to go on from; record {root} anew by --overwrite=true")
        if dataset_info(root).episodes == self.dataset.num_episodes:
            return True
        prepare_output(root, resume=False, overwrite=True)
        return False

    def _record(self, job: RolloutJob, root: Path, journals: Path) -> None:
        from manip_il.cli.stages import Stages
        from manip_il.dagger.collect import MAX_TRIES, build_dataset, check_journals, collect_successes
        from manip_il.data.journal import list_episodes, read_header
        from manip_il.engine.local import Engine, default_workers
        from manip_il.seeding import stream_seeds

        count = self.dataset.num_episodes
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, self.seed)
        warn(check_journals(journals, job))
        save_options(journals, self)
        with Stages(kept=f"every finished episode, in {journals}") as stages:
            missing = max(0, count - len(list_episodes(journals)))
            stages.start(f"record {job.env.robot} {job.env.task}", missing)
            with Engine(self.workers or default_workers()) as engine:
                paths = collect_successes(engine, job, seeds, count, journals, stages.episode)
        last = read_header(paths[-1]).seed
        tried = last - seeds[0] + 1
        provenance = {"driver": "expert", "round": 0, "beta": 1.0, "seeds": [seeds[0], last], "tried": tried}
        info = build_dataset(paths, root, job, self._repo_id(), provenance)
        say(f"recorded {info.episodes:,} successful episodes, {info.frames:,} frames; {_left_out(tried - count)}")
        say(f"dataset: {root} (its episodes one by one, with Foxglove's messages: {journals})")


def _left_out(failed: int) -> str:
    if failed == 0:
        return "no demonstration failed"
    return f"{failed} failed demonstration{'s' if failed > 1 else ''} left out"
