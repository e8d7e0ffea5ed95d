from __future__ import annotations

import io

import av
import numpy as np
import pytest
from PIL import Image

from manip_il.collect.job import RolloutJob
from manip_il.data import schema
from manip_il.evaluation.film import Shot, encode_mp4, run_states
from manip_il.tasks.config import make_config

JOB = RolloutJob(make_config(), hold=10, label="last")
SEED = 4_000_000


@pytest.fixture(scope="module")
def episode():
    return run_states(JOB, SEED)


def frames(count: int, height: int = 48, width: int = 64) -> list[np.ndarray]:
    """Pictures that get brighter."""
    return [np.full((height, width, 3), 10 * i, np.uint8) for i in range(count)]


def test_a_seed_run_again_is_the_episode_that_an_evaluation_saw(episode):
    evaluated = {other.seed: other for other in JOB.run(range(SEED, SEED + 3))}[SEED]
    assert np.array_equal(evaluated.columns[schema.SIM_STATE], episode.columns[schema.SIM_STATE])


def test_an_mp4_is_h264_for_browsers_with_its_index_in_front():
    mp4 = encode_mp4(frames(12), 10)
    assert mp4[4:8] == b"ftyp"
    assert mp4.index(b"moov") < mp4.index(b"mdat")
    means: list[float] = []
    with av.open(io.BytesIO(mp4), "r") as container:
        stream = container.streams.video[0]
        assert (stream.codec_context.name, stream.codec_context.pix_fmt) == ("h264", "yuv420p")
        assert (stream.width, stream.height, int(stream.average_rate)) == (64, 48, 10)
        means += [float(picture.to_ndarray(format="rgb24").mean()) for picture in container.decode(stream)]
    assert len(means) == 12
    assert np.allclose(means, 10 * np.arange(12), atol=3)


@pytest.mark.gl
def test_a_film_shows_every_second_state_and_its_poster_is_the_last(episode):
    film = Shot(JOB, episode, "expert", "success", stills=6).film()
    poster = np.asarray(Image.open(io.BytesIO(film.poster), formats=["jpeg"]))
    pictures: list[np.ndarray] = []
    with av.open(io.BytesIO(film.mp4), "r") as container:
        pictures += [picture.to_ndarray(format="rgb24") for picture in container.decode(video=0)]
    assert len(pictures) == -(-len(episode) // 2)
    assert poster.shape == pictures[-1].shape == (240, 320, 3)
    assert np.abs(pictures[-1].astype(int) - poster).mean() < 5
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50
    assert film.stills[0].caption == "0.0 s"
    assert len(film.stills) == 6
