from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from manip_il.engine.environments import env_spec
from manip_il.engine.jobs import RolloutJob, run_job
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig

sys.path.insert(0, str(Path(__file__).parent))  # where workers find `kept`


@pytest.fixture(scope="session")
def checkpoint(tmp_path_factory) -> Path:
    """A policy for the default environment, hardly trained."""
    from manip_il.learn.fit_config import FitConfig
    from manip_il.learn.train import fit

    job = RolloutJob(EnvConfig(), "expert", hold=3)
    episodes = list(run_job(job, stream_seeds("demonstrations", 4)))
    table = {key: np.concatenate([episode.columns[key] for episode in episodes]) for key in episodes[0].columns}
    table["episode_index"] = np.repeat(np.arange(4), [len(episode) for episode in episodes])
    config = FitConfig({"width": 32}, steps=20, batch_size=32)
    return fit(table, config, tmp_path_factory.mktemp("policy"), spec=env_spec(EnvConfig()))
