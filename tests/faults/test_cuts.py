"""A journal that is cut at any byte costs its own episode and no other."""

from __future__ import annotations

import shutil

import numpy as np
import pytest

from manip_il.collect.environments import env_fingerprint, env_spec
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data.build import build
from manip_il.data.dataset import Dataset
from manip_il.data.journal import Journal, list_episodes
from manip_il.doctor.examine import examine_folder
from manip_il.seeding import stream_seeds
from manip_il.sim.env import EnvConfig

CUTS = 20
JOB = RolloutJob(EnvConfig("fetch", "reach"), hold=1)
SEEDS = stream_seeds("demonstrations", 3)


@pytest.fixture(scope="module")
def journals(tmp_path_factory):
    folder = tmp_path_factory.mktemp("recorded") / "demos.journals"
    list(Engine().run(JOB, SEEDS, Journal(folder, env_spec(JOB.env), env_fingerprint(JOB.env))))
    return folder


@pytest.mark.slow
def test_no_cut_loses_another_episode(journals, tmp_path):
    build(journals, tmp_path / "whole")
    rng = np.random.default_rng(0)
    for number in range(CUTS):
        folder, root = tmp_path / f"{number}.journals", tmp_path / str(number)
        shutil.copytree(journals, folder)
        cut = list_episodes(folder)[number % len(SEEDS)]
        cut.write_bytes(cut.read_bytes()[: rng.integers(cut.stat().st_size)])
        result = build(folder, root)
        others = [seed for index, seed in enumerate(SEEDS) if index != number % len(SEEDS)]
        assert np.unique(Dataset.open(root).columns(["seed"])["seed"]).tolist() == others
        assert len(result.damaged) == 1
        assert cut.name in result.damaged[0]
        assert examine_folder(root) == []
        shutil.rmtree(root)
        shutil.rmtree(folder)
