"""Pictures show the scene; where there is no OpenGL the error says what to install."""

from __future__ import annotations

import multiprocessing
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from manip_il.errors import RenderError, UnknownName
from manip_il.robots.robot import ROBOTS
from manip_il.sim import render
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.env import ManipEnv
from manip_il.sim.gl import choose_backend, require_known_backend

SEED = 5_000_000


@pytest.fixture
def env(request) -> ManipEnv:
    env = ManipEnv(request.param, cameras=CAMERAS, render_mode="rgb_array")
    env.start(SEED)
    return env


@pytest.fixture
def no_context_yet() -> Iterator[None]:
    render.close()
    yield
    render.close()


with_every_robot = pytest.mark.parametrize("env", list(ROBOTS), indirect=True)


def pixels_like(picture: np.ndarray, strongest: int) -> int:
    """Pixels in which one colour (0 red, 1 green, 2 blue) stands out from both others."""
    others = np.delete(picture.astype(int), strongest, axis=2).max(axis=2)
    return int((picture[..., strongest] > others + 40).sum())


@pytest.mark.gl
@with_every_robot
@pytest.mark.filterwarnings("ignore:.*(infinity|normalized space).*:UserWarning")
def test_gymnasium_takes_the_one_with_cameras_for_its_own(env: ManipEnv):
    check_env(env)


@pytest.mark.gl
@with_every_robot
def test_cameras_show_different_pictures_with_something_on_them(env: ManipEnv):
    pictures = env.observe().images
    assert set(pictures) == set(CAMERAS)
    for picture in pictures.values():
        assert picture.shape == (128, 128, 3)
        assert picture.dtype == np.uint8
        assert picture.std() > 10
    apart = np.abs(pictures["front"].astype(int) - pictures["wrist"].astype(int))
    assert apart.mean() > 10


@pytest.mark.gl
@with_every_robot
def test_the_front_camera_sees_the_green_goal_and_the_red_cube(env: ManipEnv):
    for seed in range(SEED, SEED + 5):
        env.start(seed)
        picture = env.observe().images["front"]
        assert pixels_like(picture, 1) >= 8
        assert pixels_like(picture, 0) >= 8


@pytest.mark.gl
@with_every_robot
def test_a_state_is_the_same_picture_again(env: ManipEnv):
    state, first = env.get_state(), env.observe().images
    env.start(SEED + 1)
    other = env.observe().images["front"]
    env.set_state(state)
    again = env.observe().images
    np.testing.assert_array_equal(again["front"], first["front"])
    np.testing.assert_array_equal(again["wrist"], first["wrist"])
    assert not np.array_equal(other, first["front"])


@pytest.mark.gl
@with_every_robot
def test_the_wrist_camera_moves_with_the_hand_and_the_front_camera_does_not(env: ManipEnv):
    before = env.observe().images
    q = env.data.ctrl[env.scene.arm_ctrl].copy()
    for _ in range(10):
        env.advance(env.scene.actions.join(q + 0.3 * np.eye(len(q))[0], 0.04))
    after = env.observe().images
    share = {name: (np.abs(after[name].astype(int) - before[name]).max(axis=2) > 12).mean() for name in CAMERAS}
    assert share["wrist"] > 0.1
    assert 0.005 < share["front"] < 0.4


@pytest.mark.gl
@with_every_robot
def test_render_is_larger_and_leaves_the_cameras_as_they_were(env: ManipEnv):
    before = env.observe().images["front"]
    assert env.render().shape == (480, 640, 3)
    np.testing.assert_array_equal(env.observe().images["front"], before)


@pytest.mark.gl
@with_every_robot
def test_pictures_of_25_environments_are_those_of_one_alone(env: ManipEnv):
    crowd = [ManipEnv(env.config.robot, cameras=CAMERAS) for _ in range(25)]
    for seed, one in enumerate(crowd, SEED):
        one.start(seed)
    together = [one.observe().images for one in crowd]
    for seed, images in enumerate(together, SEED):
        env.start(seed)
        for camera, picture in env.observe().images.items():
            np.testing.assert_array_equal(images[camera], picture)


@pytest.mark.gl
def test_other_robots_looks_and_sizes_in_between_change_no_byte():
    env = ManipEnv("panda", cameras=("front",), image_size=(96, 128))
    env.start(SEED)
    first = env.observe().images["front"]
    others = [
        ManipEnv("fetch", cameras=("wrist",)),
        ManipEnv("panda", cameras=("front",), look=Look(shadows=True, brightness=2)),
        ManipEnv("panda", cameras=CAMERAS, image_size=(720, 1024)),  # larger than the buffer was made
        ManipEnv("panda", cameras=CAMERAS, image_size=(16, 18)),
    ]
    for other in others:
        other.start(SEED)
        other.observe()
        np.testing.assert_array_equal(env.observe().images["front"], first)


@pytest.mark.gl
@pytest.mark.slow
@with_every_robot
def test_another_process_draws_the_same_bytes(env: ManipEnv):
    config = CameraConfig(CAMERAS)
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        there = pool.submit(render.pictures, env.config.robot, env.config.task, env.data, config).result()
    for camera, picture in env.observe().images.items():
        np.testing.assert_array_equal(there[camera], picture)


@pytest.mark.gl
def test_the_picture_is_the_mean_of_finer_pixels_the_right_way_up():
    env = ManipEnv("panda", "reach", cameras=("front",), image_size=(64, 96))
    env.start(SEED)
    fine = render.pictures("panda", "reach", env.data, CameraConfig(("front",), 128, 192))["front"]
    blocks = fine.reshape(64, 2, 96, 2, 3).mean(axis=(1, 3))
    picture = env.observe().images["front"]
    assert np.abs(picture - blocks).mean() < 2
    assert picture[:8].mean(axis=(0, 1))[2] > picture[-8:].mean(axis=(0, 1))[2] + 20  # blue above, wood below


@pytest.mark.gl
@with_every_robot
def test_pictures_leave_the_physics_alone(env: ManipEnv):
    blind = ManipEnv(env.config.robot)
    blind.start(SEED)
    for _ in range(5):
        env.observe()
        for one in (env, blind):
            one.advance(one.scene.actions.join(one.data.ctrl[one.scene.arm_ctrl] + 0.02, 0.03))
    np.testing.assert_array_equal(env.get_state().to_vector(), blind.get_state().to_vector())


@pytest.mark.gl
def test_shadows_darken_and_brightness_brightens():
    def mean(look: Look) -> float:
        env = ManipEnv("panda", cameras=("front",), look=look)
        env.start(SEED)
        return float(env.observe().images["front"].mean())

    plain = mean(Look())
    assert mean(Look(shadows=True)) < plain - 0.3
    assert mean(Look(brightness=0.5)) < plain - 20
    assert mean(Look(brightness=1.2)) > plain + 5


@pytest.mark.gl
@pytest.mark.usefixtures("no_context_yet")
def test_a_process_makes_one_opengl_context(monkeypatch):
    made = []
    context = mujoco.GLContext

    def counted(*size: int):
        made.append(size)
        return context(*size)

    monkeypatch.setattr("mujoco.gl_context.GLContext", counted)
    for robot, look in (("panda", Look()), ("fetch", Look()), ("panda", Look(shadows=True)), ("panda", Look())):
        env = ManipEnv(robot, cameras=CAMERAS, look=look)
        env.start(SEED)
        env.observe()
    assert len(made) == 1


@pytest.mark.gl
@pytest.mark.usefixtures("no_context_yet")
def test_sizes_may_alternate_without_uploading_the_scene_again(monkeypatch):
    made = []
    context = mujoco.MjrContext

    def counted(*arguments):
        made.append(arguments)
        return context(*arguments)

    monkeypatch.setattr(mujoco, "MjrContext", counted)
    envs = [ManipEnv("panda", "reach", cameras=CAMERAS, image_size=size) for size in ((128, 128), (240, 320))]
    for env in envs * 3:
        env.start(SEED)
        env.observe()
    assert len(made) == 1


@pytest.mark.gl
@pytest.mark.slow
def test_after_a_fork_the_error_says_to_spawn():
    env = ManipEnv("panda", "reach", cameras=("front",))
    env.start(SEED)
    env.observe()
    with (
        ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("fork")) as pool,
        pytest.raises(RenderError, match="fork; start processes that make pictures by 'spawn'"),
    ):
        pool.submit(render.pictures, "panda", "reach", env.data, CameraConfig(("front",))).result()


def test_without_a_render_mode_there_is_no_picture():
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    assert env.render() is None


@pytest.mark.usefixtures("no_context_yet")
def test_without_opengl_the_error_names_debians_packages(monkeypatch):
    def broken(*_: object) -> None:
        raise ImportError("cannot load libEGL.so.1")

    monkeypatch.setattr("mujoco.gl_context.GLContext", broken)
    env = ManipEnv("panda", "reach", cameras=("front",))
    env.start(SEED)
    with pytest.raises(RenderError, match=r"libEGL\.so\.1.*apt-get install -y libegl1 libegl-mesa0") as caught:
        env.observe()
    assert caught.value.exit_code == 1


def test_an_unknown_robot_is_no_fault_of_opengl():
    env = ManipEnv("panda", "reach")
    with pytest.raises(UnknownName, match="did you mean 'panda'"):
        render.pictures("pand", "reach", env.data, CameraConfig(("front",)))


def test_the_users_choice_of_backend_stands(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert choose_backend() == "glfw"
    monkeypatch.setenv("MUJOCO_GL", "off")
    assert choose_backend() == "off"
    monkeypatch.setenv("MUJOCO_GL", "eglo")
    assert choose_backend() == "eglo"  # it is called on import, where nobody could answer an error
    with pytest.raises(RenderError, match="MUJOCO_GL is 'eglo'; expected egl or osmesa"):
        require_known_backend()
    monkeypatch.setenv("MUJOCO_GL", "EGL ")
    require_known_backend()


@pytest.mark.parametrize(
    ("there", "chosen"), [({"EGL", "OSMesa"}, "egl"), ({"EGL"}, "egl"), ({"OSMesa"}, "osmesa"), (set(), None)]
)
def test_egl_is_preferred_to_osmesa(monkeypatch, there: set[str], chosen: str | None):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: f"lib{name}.so" if name in there else None)
    assert choose_backend() == chosen
