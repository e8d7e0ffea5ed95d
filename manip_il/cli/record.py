"""`manip-il record`: a dataset of the expert's demonstrations."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il import checks
from manip_il.cli import common_options as common
from manip_il.cli.options import Given, given, group
from manip_il.cli.outputs import check_same_options, prepare_output, save_options
from manip_il.cli.progress import Stages, say, warn
from manip_il.data.atomic import exclusive
from manip_il.data.video_config import VideoConfig
from manip_il.errors import UsageError
from manip_il.option import option

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob

HOLD = 10  # control steps that a demonstration goes on for after success


def require_repo_id(value: str) -> None:
    """Raise `UsageError` unless the value is USER/NAME: a folder is named after it."""
    if "/" not in checks.repo_id("repo_id", value):
        raise UsageError(f"repo_id is {value!r}; expected USER/NAME")


@dataclass
class DatasetGroup:
    """`--dataset.*` of what is recorded."""

    repo_id: str | None = option(
        None, "USER/NAME on the Hub; by default local/ROBOT_TASK", check=require_repo_id, free=True
    )
    root: Path | None = option(None, "folder of the dataset; by default datasets/NAME", free=True)
    num_episodes: int = option(50, "successful episodes", at_least=1, grows=True)
    rgb_encoder: Given = given(VideoConfig)


@dataclass
class RecordOptions:
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is written to ROOT.journals at once; the dataset appears when all episodes are recorded.
    """

    example: ClassVar[str] = "manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos"
    first: ClassVar[str] = "robot.type task.type dataset.root dataset.num_episodes cameras seed resume"
    env: Given = common.env_given()
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
    cameras: list[str] = option(list, f"{common.CAMERAS_HELP}; by default no pictures")
    image: Given = common.image_given()
    vary: list[str] = common.vary_option()
    seed: int = common.seed_option()
    engine: common.EngineOptions = group(common.EngineOptions(), prefix="")
    resume: bool = option(False, "continue a recording, or add more episodes", free=True)
    overwrite: bool = option(False, "replace an existing dataset", free=True)

    def run(self) -> None:
        """Record; the dataset is written as the episodes come."""
        from manip_il.collect.environments import env_spec

        job = self._job()
        if job.cameras:
            from manip_il.data.video import try_encoder

            try_encoder(VideoConfig(**self.dataset.rgb_encoder), job.cameras.size, job.env.control_hz)
        env_spec(job.env, job.cameras)  # refuses what no scene can be made of, before anything is written
        repo_id = self.dataset.repo_id or f"local/{job.env.name}"
        root = self.dataset.root or Path("datasets") / repo_id.partition("/")[2]
        journals = root.with_name(f"{root.name}.journals")
        with exclusive(root):
            prepare_output(root, resume=self.resume, overwrite=self.overwrite)
            prepare_output(journals, resume=self.resume, overwrite=self.overwrite)
            if self.resume:
                check_same_options(journals, self)
            self._record(job, root, journals, repo_id)
        say(f"next: manip-il train --dataset.root={root} --output_dir=runs/{root.name}")

    def _job(self) -> RolloutJob:
        from manip_il.collect.job import RolloutJob
        from manip_il.evaluation.suites import varied

        env = common.env_config(self.env)
        cameras = common.camera_config(self.cameras, self.image, robot=env.robot) if self.cameras else None
        conditions = varied(self.vary, env, sees=cameras is not None)
        return RolloutJob(env, hold=HOLD, cameras=cameras, conditions=conditions)

    def _record(self, job: RolloutJob, root: Path, journals: Path, repo_id: str) -> None:
        from manip_il.collect.record import MAX_TRIES, collect_successes, journal_of, provenance, record
        from manip_il.data.build import Recording
        from manip_il.data.journal import list_seeds
        from manip_il.seeding import stream_seeds

        count = self.dataset.num_episodes
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, self.seed)
        warn(*journal_of(journals, job).prepare())
        save_options(journals, self)
        video = asdict(VideoConfig(**self.dataset.rgb_encoder)) if job.cameras else {}
        recording = Recording(repo_id, True, count, provenance(job), video)
        with Stages(f"every finished episode, in {journals}") as stages, self.engine.open() as engine:
            stages.start(f"record {job.env.robot} {job.env.task}", max(0, count - len(list_seeds(journals))))
            episodes = collect_successes(engine, job, seeds, count, journals, stages.episode)
            info, failed = record(episodes, journals, root, job, recording, replace=self.resume)
        say(f"recorded {info.episodes:,} successful episodes, {info.frames:,} frames; {left_out(failed)}")
        say(f"dataset: {root} (its episodes one by one, to open in Foxglove: {journals})")


def left_out(failed: int) -> str:
    """Return in words how many demonstrations failed."""
    if failed == 0:
        return "no demonstration failed"
    return f"{failed} failed demonstration{'s' if failed > 1 else ''} left out"
