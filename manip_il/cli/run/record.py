"""Run `manip-il record`: a dataset of the expert's demonstrations."""

from dataclasses import replace
from pathlib import Path

from manip_il import checks
from manip_il.bridges.doctor.models import MODELS
from manip_il.cli.imitation import RecordOptions
from manip_il.cli.outputs import Stages, locked, say, say_next
from manip_il.cli.parsing import Given
from manip_il.collect.inputs import env_config
from manip_il.collect.record import record
from manip_il.data.atomic import DATASET, EPISODES
from manip_il.data.journal import journals_of, list_seeds
from manip_il.data.video_config import VideoConfig
from manip_il.evaluation.suites import varied


def run_record(options: RecordOptions) -> None:
    """Record; the dataset is written while episodes arrive."""
    if options.preset:
        model = MODELS[options.preset]
        options = replace(
            options,
            env=Given({"control_hz": model.fps} | options.env),
            cameras=options.cameras or ["front", "wrist"],
            image=Given({"height": model.pixels, "width": model.pixels} | options.image),
            language=True,
        )
    env = env_config(options.env)
    cameras = options.camera_config(env) if options.cameras else None
    repo_id = checks.repo_id("repo_id", options.dataset.repo_id or f"local/{env.name}")
    root = options.dataset.root or Path("datasets") / repo_id.rpartition("/")[2]
    journals = journals_of(root)
    kept = f"every finished episode, in {journals}"
    with (
        locked({root: DATASET, journals: EPISODES}, options, options) as prepare,
        Stages(kept, prepare) as stages,
        options.open_engine() as engine,
    ):
        made = record(
            root,
            env,
            options.dataset.num_episodes,
            seed=options.seed,
            workers=engine,
            video=VideoConfig(**options.dataset.rgb_encoder),
            language=options.language,
            shares=options.dataset.shares,
            resume=True,
            progress=stages,
            cameras=cameras,
            conditions=varied(options.vary, env, sees=cameras is not None),
        )
    episodes, frames = made.info.episodes, made.info.frames
    failed = len(list_seeds(journals)) - episodes
    say(
        f"recorded {episodes:,} successful episodes, {frames:,} frames; demonstrations left out:"
        f" {failed}"
    )
    say(f"dataset: {root} (single episodes, to open in Foxglove: {journals})")
    say_next("train", f"--dataset.root={root}", f"--output_dir=runs/{root.name}")
