"""`manip-il record`: a dataset of the expert's demonstrations."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il import checks
from manip_il.cli.common_options import EngineOptions, Varied, env_config
from manip_il.cli.options import Given, given, group
from manip_il.cli.outputs import Resumable, check_same_options, prepare_output, require_writable, save_options
from manip_il.cli.progress import Stages, say, say_next, warn
from manip_il.data.atomic import exclusive
from manip_il.data.ownership import DATASET, EPISODES
from manip_il.data.video_config import VideoConfig
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.suites import varied
from manip_il.option import Seeded, option
from manip_il.seeding import stream_seeds
from manip_il.tasks.config import EnvConfig

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob


@dataclass(frozen=True)
class DatasetGroup:
    """`--dataset.*`: the recorded dataset."""

    repo_id: str | None = option(None, "USER/NAME on the Hub; by default local/ROBOT_TASK", free=True)
    root: Path | None = option(None, "folder of the dataset; by default datasets/NAME", free=True)
    num_episodes: int = option(50, "number of successful episodes", at_least=1, grows=True)
    rgb_encoder: Given = given(VideoConfig)


@dataclass(frozen=True)
class RecordOptions(Varied, Seeded, Resumable):
    """Record successful demonstrations of the expert as a LeRobot dataset.

    Every finished episode is written to ROOT.journals at once; the dataset appears when all episodes are recorded.
    --resume=true continues a recording; --dataset.num_episodes may then be larger.
    """

    example: ClassVar[str] = "manip-il record --dataset.num_episodes=100 --dataset.root=datasets/demos"
    first: ClassVar[str] = "robot.type task.type dataset.root dataset.num_episodes cameras seed resume"
    env: Given = given(EnvConfig)
    dataset: DatasetGroup = field(default_factory=DatasetGroup)
    engine: EngineOptions = group(EngineOptions(), prefix="")

    def run(self) -> None:
        """Record; the dataset is written while episodes arrive."""
        from manip_il.collect.environments import env_spec
        from manip_il.collect.job import RolloutJob
        from manip_il.data.video import try_encoder
        from manip_il.evaluation.runner import HOLD

        env = env_config(self.env)
        cameras = self.camera_config(env) if self.cameras else None
        job = RolloutJob(env, hold=HOLD, cameras=cameras, conditions=varied(self.vary, env, sees=cameras is not None))
        if cameras:
            try_encoder(VideoConfig(**self.dataset.rgb_encoder), cameras.size, env.control_hz)
        env_spec(env, cameras)  # raises if no scene can be made, before anything is written
        repo_id = checks.repo_id("repo_id", self.dataset.repo_id or f"local/{env.name}")
        root = self.dataset.root or Path("datasets") / repo_id.rpartition("/")[2]
        journals = root.with_name(f"{root.name}.journals")
        kinds = {root: DATASET, journals: EPISODES}
        with exclusive(root):
            for folder, kind in () if self.resume else kinds.items():  # both, before either is emptied
                require_writable(folder, kind, self.overwrite)
            if self.resume:
                if any(root.glob("*")) and not any(journals.glob("*")):
                    raise UsageError(f"{root} cannot be continued without {journals}; choose another --dataset.root")
                check_same_options(journals, self)
            for folder, kind in kinds.items():
                prepare_output(folder, kind, resume=self.resume, overwrite=self.overwrite)
            self._record(job, root, journals)
        say_next("train", f"--dataset.root={root}", f"--output_dir=runs/{root.name}")
        shape = [f"--task.object={env.object}"] if env.object else []
        say_next("view", f"--robot.type={env.robot}", f"--task.type={env.task}", *shape, what="to watch the expert")

    def _record(self, job: RolloutJob, root: Path, journals: Path) -> None:
        from manip_il.collect.record import MAX_TRIES, collect_successes, journal_of, provenance
        from manip_il.data.build import Recording
        from manip_il.data.journal import list_seeds

        count = self.dataset.num_episodes
        seeds = stream_seeds("demonstrations", MAX_TRIES * count, self.seed)
        warn(*journal_of(journals, job).prepare())
        save_options(journals, self)
        video = asdict(VideoConfig(**self.dataset.rgb_encoder)) if job.cameras else {}
        recording = Recording(True, count, provenance(job), video)
        if list_seeds(journals):
            before, now = (one.provenance.get("vary") for one in (Recording.read(journals), recording))
            if before != now:
                raise MismatchError("what --vary draws from", str(journals), before, "the command line", now)
        with Stages(f"every finished episode, in {journals}") as stages, self.engine.open() as engine:
            stages.start(f"record {job.env.robot} {job.env.task}", max(0, count - len(list_seeds(journals))))
            episodes = collect_successes(engine, job, seeds, count, journals, stages.episode)
            recording.write(journals)
            info, failed = recording.make(episodes, root, replace=self.resume)
        say(
            f"recorded {info.episodes:,} successful episodes, {info.frames:,} frames; demonstrations left out: {failed}"
        )
        say(f"dataset: {root} (single episodes, to open in Foxglove: {journals})")
