"""`manip-il record`, `build`, `render`: a dataset of demonstrations, again from its journals, with other pictures."""

from __future__ import annotations

from dataclasses import MISSING, asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar, Literal

from manip_il import checks
from manip_il.cli import common_options as common
from manip_il.cli.inputs import require_dataset, require_folder
from manip_il.cli.outputs import (
    check_output,
    check_same_options,
    prepare_output,
    require_new,
    require_output,
    save_options,
)
from manip_il.cli.progress import Stages, progress, say, warn
from manip_il.data.atomic import exclusive
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, UsageError
from manip_il.option import option, option_of
from manip_il.sim.config import CAMERAS, Look, scene_name

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.collect.workers import Engine

HOLD = 10  # control steps that a demonstration goes on for after success


@dataclass
class EncoderGroup:
    """`--dataset.rgb_encoder.*`: how pictures are compressed, in LeRobot's names."""

    vcodec: str = option_of(VideoConfig, "vcodec")
    pix_fmt: str = option_of(VideoConfig, "pix_fmt")
    g: int = option_of(VideoConfig, "g")
    crf: int | None = option_of(VideoConfig, "crf")
    preset: str | None = option_of(VideoConfig, "preset")


@dataclass
class DatasetGroup:
    """`--dataset.*` of what is recorded."""

    repo_id: str | None = option(None, "USER/NAME on the Hub; by default local/ROBOT_TASK")
    root: Path | None = option(None, "folder of the dataset; by default datasets/NAME")
    num_episodes: int = option(50, "successful episodes")
    rgb_encoder: EncoderGroup = field(default_factory=EncoderGroup)


@dataclass
class RecordOptions(common.EnvOptions):
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is written to ROOT.journals at once; the dataset appears when all episodes are recorded.
    """

    example: ClassVar[str] = "manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos"
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
    cameras: list[str] = option(list, "any of front, side, wrist; by default no pictures")
    image: common.ImageGroup = field(default_factory=common.ImageGroup)
    vary: list[str] = option(list, common.VARY_HELP)
    seed: int = common.seed_option()
    engine: Literal["local", "ray"] = common.engine_option()
    workers: int | None = common.workers_option()
    resume: bool = option(False, "continue a recording, or add more episodes")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        if self.dataset.num_episodes < 1:
            raise UsageError(f"--dataset.num_episodes is {self.dataset.num_episodes}; expected at least 1")
        require_repo_id("--dataset.repo_id", self._repo_id())
        common.require_workers(self.workers)
        root, journals = self._folders()
        check_output(root, resume=self.resume, overwrite=self.overwrite)
        if not (self.resume and root.is_dir() and any(root.iterdir())):
            require_output(journals, resume=self.resume, overwrite=self.overwrite)
        common.require_pictures(self.robot.type, self.cameras)
        from manip_il.evaluation.suites import varied

        varied(self.vary, self.env_config(), sees=bool(self.cameras))
        self.image.config(self.cameras)

    def run(self) -> None:
        """Record; the dataset is written as the episodes come."""
        env, cameras = self.env_config(), self.image.config(self.cameras)
        if cameras:
            from manip_il.data.video import try_encoder

            try_encoder(VideoConfig(**asdict(self.dataset.rgb_encoder)), cameras.size, env.control_hz)
        from manip_il.collect.environments import env_spec
        from manip_il.collect.job import RolloutJob
        from manip_il.collect.workers import Engine

        env_spec(env, cameras)  # refuses what no scene can be made of, before anything is written
        engine = Engine(self.workers, self.engine)
        root, journals = self._folders()
        with exclusive(root):
            prepare_output(root, resume=self.resume, overwrite=self.overwrite)
            prepare_output(journals, resume=self.resume, overwrite=self.overwrite)
            if self._is_complete(root, journals):
                say(f"{root} holds its {self.dataset.num_episodes} episodes already")
            else:
                from manip_il.evaluation.suites import varied

                conditions = varied(self.vary, env, sees=bool(cameras))
                job = RolloutJob(env, hold=HOLD, cameras=cameras, conditions=conditions)
                self._record(engine, job, root, journals)
        say(f"next: manip-il train --dataset.root={root} --output_dir=runs/{root.name}")

    def _repo_id(self) -> str:
        return self.dataset.repo_id or f"local/{scene_name(self.robot.type, self.task.type)}"

    def _folders(self) -> tuple[Path, Path]:
        root = self.dataset.root or Path("datasets") / self._repo_id().partition("/")[2]
        return root, root.with_name(f"{root.name}.journals")

    def _is_complete(self, root: Path, journals: Path) -> bool:
        """Return whether a resumed recording is complete."""
        from manip_il.data.dataset import Dataset

        if not self.resume:
            return False
        free = ("workers", "engine", "dataset.root", "dataset.repo_id")
        check_same_options(journals, self, free, may_grow="dataset.num_episodes")
        if not root.is_dir() or not any(root.iterdir()):
            return False
        if not journals.is_dir():
            raise ManipError(f"no {journals} to continue from; record {root} again with --overwrite=true")
        return Dataset.open(root).info.episodes == self.dataset.num_episodes

    def _record(self, engine: Engine, job: RolloutJob, root: Path, journals: Path) -> None:
        from manip_il.collect.record import MAX_TRIES, collect_successes, journal_of, provenance, record
        from manip_il.data.build import Recording
        from manip_il.data.journal import list_seeds
        from manip_il.seeding import stream_seeds

        count = self.dataset.num_episodes
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, self.seed)
        warn(*journal_of(journals, job).prepare())
        save_options(journals, self)
        video = asdict(self.dataset.rgb_encoder) if job.cameras else {}
        recording = Recording(self._repo_id(), True, count, provenance(job), video)
        kept = f"every finished episode, in {journals}"
        with Stages(kept) as stages, engine:
            stages.start(f"record {job.env.robot} {job.env.task}", max(0, count - len(list_seeds(journals))))
            episodes = collect_successes(engine, job, seeds, count, journals, stages.episode)
            info, failed = record(episodes, journals, root, job, recording, replace=self.resume)
        say(f"recorded {info.episodes:,} successful episodes, {info.frames:,} frames; {left_out(failed)}")
        say(f"dataset: {root} (its episodes one by one, to open in Foxglove: {journals})")


@dataclass
class BuildOptions:
    """Build the LeRobot dataset of a folder of journals.

    The same journals give the same bytes, those that record wrote. Unreadable journals are reported and left out; the
    exit code is then 1.
    """

    example: ClassVar[str] = "manip-il data build datasets/demos.journals datasets/demos"
    journals: Path = option(MISSING, "folder of episode-*.mcap files", positional=True)
    dataset: Path = option(MISSING, "folder of the dataset", positional=True)
    repo_id: str | None = option(None, "USER/NAME on the Hub; by default as recorded")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what the paths show to be wrong."""
        require_folder(self.journals, "one of episode-*.mcap files")
        require_new(self.dataset, overwrite=self.overwrite)
        if self.repo_id is not None:
            require_repo_id("--repo_id", self.repo_id)

    def run(self) -> None:
        """Build the dataset; `ManipError` where a journal could not be read."""
        from manip_il.data.build import build

        with exclusive(self.dataset):
            result = build(self.journals, self.dataset, repo_id=self.repo_id, replace=self.overwrite)
        say(f"built {result.info.episodes:,} episodes, {result.info.frames:,} frames; {left_out(result.failed)}")
        say(f"dataset: {self.dataset}")
        warn(*result.damaged)
        if result.damaged:
            raise ManipError(
                f"{len(result.damaged)} journal{'s' if len(result.damaged) > 1 else ''} could not be read: the dataset "
                "lacks them; record them again by `manip-il record ... --resume=true`"
            )


@dataclass
class OwnRobotGroup:
    """`--robot.*` of a dataset's robot that does not ship."""

    type: str | None = option(None, "its YAML; by default the robot is the one that ships by the dataset's name for it")


@dataclass
class RenderOptions:
    """Render a dataset's stored states: TARGET is SOURCE with other cameras, sizes or lights. Nothing is simulated."""

    example: ClassVar[str] = "manip-il data render datasets/demos datasets/dim --cameras=front --look.brightness=0.6"
    source: Path = option(MISSING, "a dataset of this program, with or without pictures", positional=True)
    target: Path = option(MISSING, "folder of the new dataset", positional=True)
    robot: OwnRobotGroup = field(default_factory=OwnRobotGroup)
    cameras: list[str] = option(lambda: list(CAMERAS), "any of front, side, wrist")
    image: common.ImageGroup = field(default_factory=common.ImageGroup)
    look: Look = field(default_factory=Look)
    workers: int | None = option(None, "processes; by default one per core")
    overwrite: bool = option(False, "replace an existing dataset")

    def check(self) -> None:
        """Refuse what paths and values show to be wrong."""
        common.require_workers(self.workers)
        require_dataset(self.source)
        source, target = self.source.resolve(), self.target.resolve()
        if source.is_relative_to(target) or target.is_relative_to(source):
            raise UsageError(f"TARGET {self.target} overlaps SOURCE {self.source}; expected a folder of its own")
        require_new(self.target, overwrite=self.overwrite)
        self.image.config(self.cameras, self.look)

    def run(self) -> None:
        """Render every episode; TARGET appears when all are there."""
        cameras = self.image.config(self.cameras, self.look)
        if cameras is None:
            raise UsageError("--cameras names none; expected any of front, side, wrist")
        from manip_il.collect.edits import Target, open_source, render_dataset
        from manip_il.collect.workers import default_workers

        source, workers = open_source(self.source, self.robot.type), self.workers or default_workers()
        warn(*source.warnings)
        with exclusive(self.target), progress(source.dataset.info.episodes, f"render {self.source}") as bar:
            info = render_dataset(source, cameras, Target(self.target, workers, self.overwrite, bar.advance))
        what = f"{', '.join(cameras.names)}, {cameras.height} x {cameras.width} pixels"
        say(f"rendered {info.episodes:,} episodes, {info.frames:,} frames: {what}")
        say(f"dataset: {self.target}")


def require_repo_id(option: str, value: str) -> None:
    """Raise `UsageError` unless the value is USER/NAME: a folder is named after it."""
    try:
        checks.repo_id(option, value)
    except ManipError as error:
        raise UsageError(str(error)) from None
    if "/" not in value:
        raise UsageError(f"{option} is {value!r}; expected USER/NAME")


def left_out(failed: int) -> str:
    """Return in words how many demonstrations failed."""
    if failed == 0:
        return "no demonstration failed"
    return f"{failed} failed demonstration{'s' if failed > 1 else ''} left out"
