"""Policies that are fitted a little to a few of the expert's episodes."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from manip_il.collect.environments import env_spec
from manip_il.collect.job import RolloutJob
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig


def clone(env: EnvConfig, episodes: int, folder: Path, *, steps: int, width: int = 32, batch_size: int = 32) -> Path:
    """Write a policy of `env`, fitted to so many of the expert's episodes, into a folder."""
    from manip_il.learn.fit_config import FitConfig
    from manip_il.learn.train import fit

    runs = list(RolloutJob(env, hold=3).run(stream_seeds("demonstrations", episodes)))
    table = {key: np.concatenate([episode.columns[key] for episode in runs]) for key in runs[0].columns}
    table["episode_index"] = np.repeat(np.arange(episodes), [len(episode) for episode in runs])
    config = FitConfig({"width": width}, steps=steps, batch_size=batch_size)
    return fit(table, config, folder, spec=env_spec(env))
