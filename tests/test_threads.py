"""Calls in several threads of one process give what the same calls give one after another."""

from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

import manip_il
from manip_il.data.dataset import Dataset

SEEDS = (0, 1, 2)


def test_three_threads_record_what_they_record_in_turn(tmp_path: Path):
    env = manip_il.make_config("panda", "lift")

    def recorded(folder: Path, seed: int) -> Dataset:
        return manip_il.record(folder / str(seed), env, 3, seed=seed)

    in_turn = [recorded(tmp_path / "in_turn", seed) for seed in SEEDS]
    with ThreadPoolExecutor(len(SEEDS)) as threads:
        at_once = list(threads.map(lambda seed: recorded(tmp_path / "at_once", seed), SEEDS))
    for one, other in zip(in_turn, at_once, strict=True):
        assert one.columns().keys() == other.columns().keys()
        for name, column in one.columns().items():
            np.testing.assert_array_equal(column, other.columns()[name], name)


@pytest.mark.gl
def test_three_threads_see_what_they_see_in_turn():
    def seen(seed: int) -> list[bytes]:
        env = manip_il.make_env("panda", "lift", cameras=["front", "wrist"], image_size=(64, 64))
        pictures = []
        for number in range(3):
            observation, _ = env.reset(seed=10 * seed + number)
            pictures += [picture.tobytes() for picture in observation["pixels"].values()]
        return pictures

    in_turn = [seen(seed) for seed in SEEDS]
    with ThreadPoolExecutor(len(SEEDS)) as threads:
        assert list(threads.map(seen, SEEDS)) == in_turn
