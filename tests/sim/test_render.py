"""Pictures show the scene; where there is no OpenGL the error says what to install."""

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from typing import Any

import mujoco
import numpy as np
import pytest

from manip_il.errors import RenderError
from manip_il.robots import ROBOTS
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.env import ManipEnv
from manip_il.sim.world import GOAL
from manip_il.tasks.objects import UPRIGHT
from manip_il.worlds.ladder.world import scene_of

from ..scenes import SEED, started

pytestmark = pytest.mark.system


@pytest.fixture
def env(request) -> ManipEnv:
    return started(request.param, cameras=CAMERAS, render_mode="rgb_array")


@pytest.fixture
def no_context_yet() -> Iterator[None]:
    render.close()
    yield
    render.close()


with_every_robot = pytest.mark.parametrize("env", list(ROBOTS), indirect=True)
with_one_robot = pytest.mark.parametrize("env", ["so101"], indirect=True)


def pixels_like(picture: np.ndarray, strongest: int) -> int:
    """Pixels in which one colour (0 red, 1 green, 2 blue) stands out from both others."""
    others = np.delete(picture.astype(int), strongest, axis=2).max(axis=2)
    return int((picture[..., strongest] > others + 40).sum())


@pytest.mark.gl
@with_every_robot
def test_the_front_camera_sees_the_green_goal_and_the_red_cube(env: ManipEnv):
    for seed in range(SEED, SEED + 5):
        env.start(seed)
        picture = env.observe().images["front"]
        assert pixels_like(picture, 1) >= 8
        assert pixels_like(picture, 0) >= 8
    env.world.place(GOAL, np.array([0.0, 0.0, -1.0]), UPRIGHT)
    assert pixels_like(env.observe().images["front"], 1) == 0


@pytest.mark.gl
@with_every_robot
def test_the_wrist_camera_moves_with_the_hand_and_the_front_camera_does_not(env: ManipEnv):
    before = env.observe().images
    first_joint = np.eye(len(env.scene.arm_ctrl))[0]
    turned = env.scene.actions.join(env.data.ctrl[env.scene.arm_ctrl] + 0.3 * first_joint, 0.04)
    for _ in range(10):
        env.advance(turned)
    after = env.observe().images
    share = {
        name: (np.abs(after[name].astype(int) - before[name]).max(axis=2) > 12).mean()
        for name in CAMERAS
    }
    assert share["wrist"] > 0.1
    assert 0.005 < share["front"] < 0.4


@pytest.mark.gl
@with_one_robot
def test_nothing_that_is_drawn_in_between_changes_a_byte(env: ManipEnv):
    def same() -> bool:
        return all(
            np.array_equal(picture, first[name]) for name, picture in env.observe().images.items()
        )

    state, first = env.get_state(), env.observe().images
    assert env.render().shape == (480, 640, 3)
    assert same()
    env.start(SEED + 1)
    assert not np.array_equal(env.observe().images["front"], first["front"])
    env.set_state(state)
    assert same()
    others: list[dict[str, Any]] = [
        {"robot": "fetch", "cameras": ("wrist",)},
        {"robot": "panda", "cameras": ("front",), "look": Look(shadows=True, brightness=2)},
        # larger than the buffer was made
        {"robot": "panda", "cameras": CAMERAS, "image_size": (720, 1024)},
        {"robot": "panda", "cameras": CAMERAS, "image_size": (16, 18)},
    ]
    for other in others:
        started(**other).observe()
        assert same()


def _drawn(
    robot: str, task: str, data: mujoco.MjData, cameras: CameraConfig
) -> dict[str, render.Picture]:
    return render.pictures(scene_of(robot, task), data, cameras)


@pytest.mark.gl
@pytest.mark.slow
@with_one_robot
def test_another_process_draws_the_same_bytes(env: ManipEnv):
    config = CameraConfig(CAMERAS)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(_drawn, env.scene.robot.name, env.task, env.data, config).result()
    for camera, picture in env.observe().images.items():
        np.testing.assert_array_equal(there[camera], picture)


@pytest.mark.gl
def test_shadows_darken_and_brightness_brightens():
    def mean(look: Look) -> float:
        return float(started(cameras=("front",), look=look).observe().images["front"].mean())

    plain = mean(Look())
    assert mean(Look(shadows=True)) < plain - 0.3
    assert mean(Look(brightness=0.5)) < plain - 20
    assert mean(Look(brightness=1.2)) > plain + 5


@pytest.mark.usefixtures("no_context_yet")
def test_without_opengl_the_error_names_debians_packages(monkeypatch):
    def broken(*_: object) -> None:
        raise ImportError("cannot load libEGL.so.1")

    monkeypatch.setattr("mujoco.egl.GLContext", broken)
    env = started("panda", "reach", cameras=("front",))
    with pytest.raises(
        RenderError, match=r"libEGL\.so\.1.*apt-get install -y libegl1 libegl-mesa0"
    ) as caught:
        env.observe()
    assert caught.value.exit_code == 1
