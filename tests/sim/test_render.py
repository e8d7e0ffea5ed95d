"""Pictures show the scene; where there is no OpenGL the error says what to install."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from gymnasium.utils.env_checker import check_env

from manip_il.errors import RenderError, UnknownName
from manip_il.sim.env import ManipEnv
from manip_il.sim.gl import choose_backend
from manip_il.sim.render import Renderer
from manip_il.sim.scene import CAMERAS, build_scene

ROBOTS = ("panda", "fetch")
SEED = 5_000_000


@pytest.fixture
def env(request):
    env = ManipEnv(request.param, cameras=CAMERAS, render_mode="rgb_array")
    env.start(SEED)
    yield env
    env.close()


both_robots = pytest.mark.parametrize("env", ROBOTS, indirect=True)


def pixels_like(picture: np.ndarray, strongest: int) -> int:
    """Pixels in which one colour (0 red, 1 green, 2 blue) stands out from both others."""
    others = np.delete(picture.astype(int), strongest, axis=2).max(axis=2)
    return int((picture[..., strongest] > others + 40).sum())


@pytest.mark.gl
@both_robots
@pytest.mark.filterwarnings("ignore:.*(infinity|normalized space).*:UserWarning")
def test_gymnasium_takes_the_one_with_cameras_for_its_own(env: ManipEnv):
    check_env(env)


@pytest.mark.gl
@both_robots
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
@both_robots
def test_the_front_camera_sees_the_green_goal_and_the_red_cube(env: ManipEnv):
    for seed in range(SEED, SEED + 5):
        env.start(seed)
        picture = env.observe().images["front"]
        assert pixels_like(picture, 1) >= 8
        assert pixels_like(picture, 0) >= 8


@pytest.mark.gl
@both_robots
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
@both_robots
def test_the_wrist_camera_moves_with_the_hand_and_the_front_camera_does_not(env: ManipEnv):
    before = env.observe().images
    q = env.data.ctrl[env.scene.arm_ctrl].copy()
    for _ in range(10):
        env.advance(np.append(q + [0.3, 0, 0, 0, 0, 0, 0], 0.04))
    after = env.observe().images
    share = {name: (np.abs(after[name].astype(int) - before[name]).max(axis=2) > 12).mean() for name in CAMERAS}
    assert share["wrist"] > 0.1
    assert 0.005 < share["front"] < 0.4


@pytest.mark.gl
@both_robots
def test_render_is_larger_and_leaves_the_cameras_as_they_were(env: ManipEnv):
    before = env.observe().images["front"]
    assert env.render().shape == (480, 640, 3)
    np.testing.assert_array_equal(env.observe().images["front"], before)


@pytest.mark.gl
def test_an_unknown_camera_answers_with_the_nearest():
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    with Renderer(env.scene, 64, 64) as renderer, pytest.raises(UnknownName, match="did you mean 'front'"):
        renderer.picture(env.data, "frnt")


def test_without_a_render_mode_there_is_no_picture():
    env = ManipEnv("panda", "reach")
    env.start(SEED)
    assert env.render() is None


def test_without_opengl_the_error_names_debians_packages(monkeypatch):
    def broken(*_: object, **__: object) -> None:
        raise ImportError("cannot load libEGL.so.1")

    monkeypatch.setattr(mujoco, "Renderer", broken)
    with pytest.raises(RenderError, match=r"libEGL\.so\.1.*apt-get install -y libegl1 libegl-mesa0") as caught:
        Renderer(build_scene("panda", "reach"))
    assert caught.value.exit_code == 1


def test_the_users_choice_of_backend_stands(monkeypatch):
    monkeypatch.setenv("MUJOCO_GL", "glfw")
    assert choose_backend() == "glfw"


@pytest.mark.parametrize(
    ("there", "chosen"), [({"EGL", "OSMesa"}, "egl"), ({"EGL"}, "egl"), ({"OSMesa"}, "osmesa"), (set(), None)]
)
def test_egl_is_preferred_to_osmesa(monkeypatch, there: set[str], chosen: str | None):
    monkeypatch.delenv("MUJOCO_GL", raising=False)
    monkeypatch.setattr("ctypes.util.find_library", lambda name: f"lib{name}.so" if name in there else None)
    assert choose_backend() == chosen
