"""Pictures that are decoded, at once or when they are read, are LeRobot's.

It imports torch: some seconds.
"""

import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from manip_il.data import schema as s
from manip_il.data.camera import decode
from manip_il.data.dataset import Dataset
from manip_il.data.video_config import VideoConfig
from manip_il.mdp import Episode

from ..pictures import numbered_episodes, write
from .test_other_peoples import NAMES, SIZE, record

pytestmark = pytest.mark.slow
FRONT, WRIST = "observation.images.front", "observation.images.wrist"
RECORDED = ("video", "image")


@pytest.fixture(scope="module")
def roots(
    tmp_path_factory: pytest.TempPathFactory,
    make_episode: Callable[..., Episode],
    two: s.EnvironmentSpec,
) -> dict[str, Path]:
    """Ours with either codec, in several files; what LeRobot records.

    What it makes of two by aggregating.
    """
    from lerobot.datasets.aggregate import aggregate_datasets

    folder = tmp_path_factory.mktemp("datasets")
    for codec in ("h264", "libsvtav1"):
        five = numbered_episodes(make_episode, two, 5)
        write(five, folder / codec, two, video=VideoConfig(codec), size=0.001)
    os.environ.setdefault("SVT_LOG", "1")  # or the encoder tells its life
    for kind in RECORDED:
        camera = {"dtype": kind, "shape": (*SIZE, 3), "names": NAMES}
        record(folder / kind, ["fold"] * 3, **{FRONT: camera, WRIST: camera})
    pair = [folder / "video", folder / "video"]
    aggregate_datasets(["a/one", "a/two"], "a/all", roots=pair, aggr_root=folder / "aggregated")
    return {path.name: path for path in folder.iterdir()}


@pytest.mark.parametrize("name", ["h264", "libsvtav1", *RECORDED, "aggregated"])
def test_what_is_decoded_at_once_or_when_it_is_read_is_bit_equal_to_what_lerobot_gives(roots, name):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root, counts = roots[name], list[int]()
    cameras = {key: Dataset.open(root).camera(key) for key in Dataset.open(root).cameras}
    frames = {key: decode([camera], counts.append) for key, camera in cameras.items()}
    twice = decode([cameras[FRONT]] * 2)
    np.testing.assert_array_equal(twice, np.concatenate([frames[FRONT]] * 2))
    plain: Any = LeRobotDataset("a/b", root=root)
    assert {*frames} >= {FRONT, WRIST}
    assert sum(counts) == len(frames) * len(plain) == len(frames) * len(frames[FRONT]) > 40
    rows = np.random.default_rng(0).integers(0, len(plain), 12)
    for key, values in frames.items():
        seen = cameras[key].rows(rows).transpose(0, 3, 1, 2)
        np.testing.assert_array_equal(seen, values[rows], strict=True)
    for row in range(len(plain)):
        theirs = plain[row]
        assert int(theirs["index"]) == row
        for key, values in frames.items():
            assert theirs[key].dtype.is_floating_point
            np.testing.assert_array_equal(
                (theirs[key] * 255).numpy(), values[row].astype(np.float32)
            )
