"""Synthetic episodes: right columns, random numbers, no simulator."""

from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.mdp import Episode

MakeEpisode = Callable[..., Episode]


@pytest.fixture(scope="session", autouse=True)
def offline(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """LeRobot reads through Hugging Face's `datasets`: no network, and a cache that goes away."""
    with pytest.MonkeyPatch.context() as patch:  # before either is imported: they read these once
        patch.setenv("HF_HUB_OFFLINE", "1")
        patch.setenv("HF_DATASETS_CACHE", str(tmp_path_factory.mktemp("hf_cache")))
        yield


@pytest.fixture(scope="session")
def spec() -> s.EnvironmentSpec:
    return s.EnvironmentSpec(
        robot="panda",
        task="lift",
        fps=20,
        joint_names=("shoulder", "elbow", "gripper"),
        environment_state_names=(
            *("ee.x", "ee.y", "ee.z"),
            *(f"ee.r{row}{column}" for column in "yz" for row in "xyz"),
            *(
                "object.x",
                "object.y",
                "object.z",
                "object.cos4yaw",
                "object.sin4yaw",
                "object_from_ee.x",
            ),
        ),
        sim_state_size=7,
        instruction="Lift the cube, 100 %.",
    )


@pytest.fixture(scope="session")
def make_episode(spec: s.EnvironmentSpec) -> MakeEpisode:
    def make(seed: int, length: int = 9, success: bool = True) -> Episode:
        rng = np.random.default_rng(seed)
        columns = {key: _random(rng, length, feature) for key, feature in s.features(spec).items()}
        columns[s.SEED][:] = seed
        columns[s.SUCCESS][:] = False
        columns[s.SUCCESS][-1] = success
        columns[s.DONE][:, 0] = np.arange(length) == length - 1
        return Episode(seed, columns, success, success)

    return make


@pytest.fixture(scope="session")
def episodes(make_episode: MakeEpisode) -> list[Episode]:
    """Three of different lengths, one of them a single frame."""
    return [make_episode(5, 7), make_episode(6, 1, success=False), make_episode(12_000_007, 12)]


def _random(rng: np.random.Generator, length: int, feature: dict[str, Any]) -> np.ndarray:
    shape = (length, *feature["shape"])
    if feature["dtype"].startswith("float"):
        return rng.normal(size=shape).astype(feature["dtype"])
    return rng.integers(0, 2, shape).astype(feature["dtype"])
