"""Pictures of a world of one's own, at the speed of software rendering."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.caching import cached_per_thread
from manip_il.errors import UsageError
from manip_il.sim.config import CameraConfig
from manip_il.sim.render import Canvas
from manip_il.sim.view import simplify_meshes
from manip_il.worlds.gym.restoring import model_arrays, simulation
from manip_il.worlds.gym.world import GymWorld

VERSION = 2  # changes when pictures do
RENDER = ("render",)  # the camera of an environment that draws itself
_CELL = 0.004  # least cell size of simplified meshes [m]
_SHADOWS = 512  # most texels of a shadow map's side; 4096, the default, take three times as long
# what of a model may differ between episodes and be seen
_SEEN = ("body_", "geom_", "site_", "cam_", "light_", "mat_rgba", "tendon_")


def camera_names(env: Any) -> tuple[str, ...]:
    """Return the names of the cameras of an environment's model, or `RENDER`; () if nothing
    draws it.
    """
    if found := simulation(env):
        model, _ = found
        named = (model.camera(number).name for number in range(model.ncam))
        return tuple(name for name in named if name) or (RENDER if env.render_mode else ())
    return RENDER if env.render_mode == "rgb_array" else ()


def draw(world: GymWorld, env: Any, camera: str, cameras: CameraConfig) -> NDArray[np.uint8]:
    """Return a picture of an environment's present state, (height, width, 3).

    Args:
        world: The world.
        env: Its environment.
        camera: Name of the camera.
        cameras: Size of the picture; lamps and shadows are the model's.

    Raises:
        RenderError: if there is no off-screen OpenGL.
        UsageError: if `render` of the world or its environment returned something else.
    """
    picture: Any = world.render(env, camera, cameras)
    if picture is None and (found := simulation(env)) and (camera,) != RENDER:
        return painted(type(world), world.task, found, camera, cameras)
    if picture is None:
        picture = env.render()
    picture = np.asarray(picture)
    if picture.dtype != np.uint8 or picture.ndim != 3 or picture.shape[-1] != 3:
        raise UsageError(
            f"render of {type(world).__name__} returned {picture.dtype} of shape {picture.shape};"
            " expected uint8 (height, width, 3)"
        )
    if picture.shape[:2] != cameras.size:
        height, width = cameras.size
        picture = np.asarray(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX))
    return picture


def painted(
    cls: type[GymWorld],
    task: str,
    simulated: tuple[mujoco.MjModel, mujoco.MjData],
    camera: str,
    cameras: CameraConfig,
) -> NDArray[np.uint8]:
    """Return a picture of a simulation, (height, width, 3), drawn from a copy of its model with
    fewer faces.

    Args:
        cls: The world.
        task: Its task.
        simulated: Model and data of the environment.
        camera: Name of the camera in the model.
        cameras: Size of the picture; lamps and shadows are the model's.
    """
    return _painter(cls, task).picture(*simulated, camera, cameras.size)


class _Painter:
    def __init__(self, model: mujoco.MjModel):
        drawn: Any = copy.copy(model)
        simplify_meshes(drawn, _CELL)
        quality = drawn.vis.quality
        quality.offsamples = 0  # the canvas smooths edges itself
        quality.shadowsize = min(quality.shadowsize, _SHADOWS)
        self._canvas = Canvas(drawn)
        self._arrays = [name for name in model_arrays(model) if name.startswith(_SEEN)]

    def picture(
        self, model: Any, data: Any, camera: str, size: tuple[int, int]
    ) -> NDArray[np.uint8]:
        for name in self._arrays:
            getattr(self._canvas.model, name)[:] = getattr(model, name)
        self._canvas.pose(data)
        return self._canvas.picture(model.camera(camera).id, size)


@cached_per_thread(4)
def _painter(cls: type[GymWorld], task: str) -> _Painter:
    """What draws a world's states in this thread, for any number of its environments."""
    env = cls(task).make()
    env.reset(seed=0)
    model, _ = simulation(env) or (None, None)
    assert model is not None  # `draw` has seen it
    return _Painter(model)
