"""Policies that are fitted a little to a few of the expert's episodes."""

from pathlib import Path

from manip_il.collect.job import RolloutJob
from manip_il.seeding import stream_seeds
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec


def clone(
    env: EnvConfig,
    episodes: int,
    folder: Path,
    *,
    steps: int,
    width: int = 32,
    batch_size: int = 32,
) -> Path:
    """Write a policy of `env`, fitted to so many of the expert's episodes, into a folder."""
    from manip_il.data.dataset import Dataset
    from manip_il.data.lerobot_write import write_dataset
    from manip_il.learn.fit_config import FitConfig
    from manip_il.learn.train import Trainer

    runs = RolloutJob(env, hold=3).run(stream_seeds("demonstrations", episodes))
    write_dataset(runs, folder / "dataset", env_spec(env), fingerprint={})
    config = FitConfig({"width": width}, steps=steps, batch_size=batch_size)
    return Trainer((Dataset.open(folder / "dataset"),), config, folder).fit()
