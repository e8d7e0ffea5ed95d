"""Run `manip-il record`: a dataset of the expert's demonstrations."""

from __future__ import annotations

from dataclasses import asdict
from pathlib import Path

from manip_il import checks
from manip_il.cli.outputs import check_same_options, prepare_output, require_writable, save_options
from manip_il.cli.progress import Stages, say, say_next, warn
from manip_il.cli.record import RecordOptions
from manip_il.cli.run.inputs import env_config
from manip_il.collect.job import RolloutJob
from manip_il.collect.record import MAX_TRIES, collect_successes, journal_of, provenance
from manip_il.data.atomic import exclusive
from manip_il.data.build import Recording
from manip_il.data.journal import list_seeds
from manip_il.data.ownership import DATASET, EPISODES
from manip_il.data.video import try_encoder
from manip_il.data.video_config import VideoConfig
from manip_il.errors import MismatchError, UsageError
from manip_il.evaluation.runner import HOLD
from manip_il.evaluation.suites import varied
from manip_il.seeding import stream_seeds
from manip_il.worlds.table import env_spec


def run_record(options: RecordOptions) -> None:
    """Record; the dataset is written while episodes arrive."""
    env = env_config(options.env)
    cameras = options.camera_config(env) if options.cameras else None
    job = RolloutJob(env, hold=HOLD, cameras=cameras, conditions=varied(options.vary, env, sees=cameras is not None))
    encoder = VideoConfig(**options.dataset.rgb_encoder)
    if cameras:
        try_encoder(encoder, cameras.size, env.control_hz)
    env_spec(env, cameras)  # raises if no scene can be made, before anything is written
    repo_id = checks.repo_id("repo_id", options.dataset.repo_id or f"local/{env.name}")
    root = options.dataset.root or Path("datasets") / repo_id.rpartition("/")[2]
    journals = root.with_name(f"{root.name}.journals")
    kinds = {root: DATASET, journals: EPISODES}
    count = options.dataset.num_episodes
    recording = Recording(True, count, provenance(job), asdict(encoder) if cameras else {})
    with exclusive(root):
        for folder, kind in () if options.resume else kinds.items():  # both, before either is emptied
            require_writable(folder, kind, options.overwrite)
        if options.resume:
            if any(root.glob("*")) and not any(journals.glob("*")):
                raise UsageError(f"{root} cannot be continued without {journals}; choose another --dataset.root")
            check_same_options(journals, options)
        for folder, kind in kinds.items():
            prepare_output(folder, kind, resume=options.resume, overwrite=options.overwrite)
        warn(*journal_of(journals, job).prepare())
        save_options(journals, options)
        if finished := list_seeds(journals):
            before, now = (one.provenance.get("vary") for one in (Recording.read(journals), recording))
            if before != now:
                raise MismatchError("what --vary draws from", str(journals), before, "the command line", now)
        with Stages(f"every finished episode, in {journals}") as stages, options.engine.open() as engine:
            stages.start(f"record {env.robot} {env.task}", max(0, count - len(finished)))
            seeds = stream_seeds("demonstrations", MAX_TRIES * count, options.seed)
            episodes = collect_successes(engine, job, seeds, count, journals, stages.episode)
            recording.write(journals)
            info, failed = recording.make(episodes, root, replace=options.resume)
    say(f"recorded {info.episodes:,} successful episodes, {info.frames:,} frames; demonstrations left out: {failed}")
    say(f"dataset: {root} (single episodes, to open in Foxglove: {journals})")
    say_next("train", f"--dataset.root={root}", f"--output_dir=runs/{root.name}")
