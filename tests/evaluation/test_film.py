from __future__ import annotations

import io

import av
import numpy as np
import pytest
from PIL import Image

from manip_il.collect.environments import env_spec
from manip_il.collect.job import RolloutJob
from manip_il.data import schema
from manip_il.errors import ManipError
from manip_il.evaluation.film import encode_mp4, film, filmed_steps, make_film, paths, pictures_of, run_states
from manip_il.evaluation.maps import draw_paths
from manip_il.sim.env import EnvConfig
from manip_il.tasks import NAMES

JOB = RolloutJob(EnvConfig(), label="last")
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


def test_a_film_ends_a_second_after_success(episode):
    first = int(np.argmax(episode.columns[schema.SUCCESS])) + 1
    assert episode.success
    assert filmed_steps(episode, 20) == first + 20 < len(episode)


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


@pytest.mark.parametrize(("pictures", "words"), [([], "no frames"), (frames(1, 47), "64 x 47")])
def test_what_cannot_be_a_film_is_refused(pictures, words):
    with pytest.raises(ManipError, match=words):
        encode_mp4(pictures, 10)


def test_a_films_poster_is_its_last_frame():
    pictures = frames(12)
    made = make_film("policy", pictures, 10, "seed 7", success=False)
    poster = np.asarray(Image.open(io.BytesIO(made.poster), formats=["jpeg"]))
    assert poster.shape == pictures[-1].shape
    assert np.allclose(poster, pictures[-1], atol=3)
    assert (made.policy, made.caption, made.success, made.mp4[4:8]) == ("policy", "seed 7", False, b"ftyp")


def test_a_strip_goes_from_the_first_to_the_last_frame():
    pictures_at = pictures_of(frames(21), 10, count=6)
    assert [seconds for seconds, _ in pictures_at] == [0.0, 0.4, 0.8, 1.2, 1.6, 2.0]
    pictures = [np.asarray(Image.open(io.BytesIO(png))) for _, png in pictures_at]
    assert [int(picture.mean()) for picture in pictures] == [0, 40, 80, 120, 160, 200]
    assert len(pictures_of(frames(2), 10, count=6)) == 2


def test_paths_end_with_the_object_at_the_goal(episode):
    drawn = paths(episode, env_spec(JOB.env), "expert")
    assert len(drawn.hand) == len(drawn.obj) == filmed_steps(episode, 20)
    assert np.linalg.norm(drawn.obj[-1] - drawn.goal) < JOB.env.tolerance
    assert np.linalg.norm(drawn.obj[0] - drawn.goal) > JOB.env.tolerance
    assert drawn.dt == pytest.approx(0.05)


def test_paths_of_a_task_without_an_object_follow_the_hand():
    job = RolloutJob(EnvConfig(task="reach"))
    drawn = paths(run_states(job, SEED), env_spec(job.env), "expert")
    assert np.array_equal(drawn.hand, drawn.obj)


@pytest.mark.parametrize("task", NAMES)
def test_paths_are_drawn_of_every_task_with_a_goal_or_without(task):
    job = RolloutJob(EnvConfig(task=task, horizon=20))
    drawn = paths(run_states(job, SEED), env_spec(job.env), "expert")
    assert np.array_equal(drawn.hand, drawn.obj) == (task == "reach")
    marked = ("reach", "lift", "pick_place", "push", "carry")
    for view in draw_paths(drawn):
        assert (view.goal is None) == (drawn.goal is None) == (task not in marked)


@pytest.mark.gl
def test_a_film_shows_every_second_state_and_things_that_move(episode):
    pictures = film(episode, JOB.env, size=(60, 80), every=2)
    assert len(pictures) == -(-filmed_steps(episode, 20) // 2)
    assert all(picture.shape == (60, 80, 3) and picture.dtype == np.uint8 for picture in pictures)
    assert pictures[0].std() > 10
    assert np.abs(pictures[0].astype(int) - pictures[-1]).max() > 50
