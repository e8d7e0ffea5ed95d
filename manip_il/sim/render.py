"""Off-screen pictures of a simulator state: one OpenGL context per thread, for any number of
environments.
"""

from __future__ import annotations

import atexit
import math
import os
from importlib import import_module
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.caching import cached_per_thread
from manip_il.errors import RenderError
from manip_il.mdp import F32, F64
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.props import Prop, props
from manip_il.sim.scene import camera_id
from manip_il.sim.variation import part
from manip_il.sim.view import ViewModel
from manip_il.sim.world import Scene

Picture = NDArray[np.uint8]
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
# if no picture can be rendered
REMEDY = f"unset MUJOCO_GL if it is set; on Debian: apt-get install -y {PACKAGES}"
_FINER = 2  # supersampling each way: cheaper than OpenGL's antialiasing, which redraws the meshes
_MAX_GEOMS = 1_000
_EE = 4  # group of the site `ee`, the robot's only one
_AXES = 0.06, 0.006  # length and thickness of the axes drawn at `ee` [m]


def pictures(
    scene: Scene,
    data: mujoco.MjData,
    cameras: CameraConfig,
    variation: F64 | None = None,
    *,
    axes: bool = False,
) -> dict[str, Picture]:
    """Return what every camera sees of the physics.

    A picture's bytes depend only on the variation, `qpos` and mocap poses, not on earlier pictures.

    Args:
        scene: The scene.
        data: Its data.
        cameras: The cameras, and the size and look of their pictures.
        variation: The world's variation, (v,); by default the scene's own.
        axes: Whether to draw the axes of `ee`: x red, y green, z blue.

    Returns:
        Camera name -> RGB picture, uint8 (height, width, 3).

    Raises:
        RenderError: If there is no off-screen OpenGL; it says what to unset or install.
    """
    renderer = _renderer(scene, cameras.look)
    renderer.pose(data, scene.nominal if variation is None else variation)
    return {name: renderer.picture(name, cameras.size, axes=axes) for name in cameras.names}


def projections(scene: Scene, cameras: CameraConfig, points: F64) -> dict[str, F32]:
    """Return where points of the world are in this thread's last `pictures`.

    Args:
        scene: The scene of these pictures.
        cameras: The cameras of these pictures.
        points: Points of the world, (K, 3) [m].

    Returns:
        Camera name -> (K, 3): position across and down, each from 0 to 1, then 1. All three are 0
        for a point outside the picture. A point inside may be hidden behind others.

    Raises:
        RenderError: If there is no off-screen OpenGL.
    """
    renderer = _renderer(scene, cameras.look)
    return {
        name: renderer.project(name, points, cameras.width / cameras.height)
        for name in cameras.names
    }


def close() -> None:
    """Free this thread's OpenGL context; the next picture makes another."""
    if _context.own.cache_info().currsize:
        gl = _context()
        gl.make_current()
        _prepared.own.cache_clear()
        gl.free()
        _context.own.cache_clear()


def _renderer(scene: Scene, look: Look) -> _Renderer:
    """The renderer that was used last, or a new one in its place, in this thread's OpenGL
    context.
    """
    try:
        _context().make_current()
        return _prepared(scene, look)
    except Exception as error:  # mujoco raises many kinds of errors, from ImportError to its own
        raise RenderError(
            f"no off-screen OpenGL ({type(error).__name__}: {error}); {REMEDY}"
        ) from error


@cached_per_thread()
def _context() -> Any:
    """This thread's OpenGL context."""
    # mujoco may have been imported before it was set
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    made_by = import_module(
        f"mujoco.{backend if backend in ('egl', 'osmesa') else 'glfw'}"
    ).GLContext
    # its destructor needs it even if its constructor failed
    setattr(made_by, "_context", None)  # noqa: B010
    gl = made_by(1, 1)  # any size will do, as pictures have a buffer of their own
    atexit.register(close)
    return gl


@cached_per_thread(1)
def _prepared(scene: Scene, look: Look) -> _Renderer:
    return _Renderer(scene, look)


class _Renderer:
    """Draws one scene in one look, in pictures of any size. Needs a current OpenGL context."""

    def __init__(self, scene: Scene, look: Look):
        self._view = ViewModel(scene, look)
        self._model = self._view.model
        self._data, self._props = mujoco.MjData(self._model), list[Prop]()
        scale = self._model.vis.scale
        scale.framelength, scale.framewidth = np.array(_AXES) / self._model.stat.meansize
        self._of = scene
        self._scene: Any = mujoco.MjvScene(self._model, _MAX_GEOMS)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._cameras = {name: camera_id(self._model, name) for name in CAMERAS}
        self._context: Any = mujoco.MjrContext(self._model, mujoco.mjtFontScale.mjFONTSCALE_100)
        mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
        if self._context.currentBuffer != mujoco.mjtFramebuffer.mjFB_OFFSCREEN:
            raise RuntimeError("the context has no off-screen buffers")

    def pose(self, data: mujoco.MjData, variation: F64) -> None:
        """Take the poses from `data`, and apply the look of a variation (v,)."""
        self._view.apply(variation)
        self._data.qpos[:] = data.qpos
        self._data.mocap_pos[:], self._data.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self._model, self._data)
        mujoco.mj_camlight(self._model, self._data)
        self._props = props(self._of, self._data, part(variation, "clutter"))

    def picture(self, camera: str, size: tuple[int, int], *, axes: bool) -> Picture:
        height, width = (_FINER * side for side in size)
        most_wide, most_high = self._context.offWidth, self._context.offHeight
        if height > most_high or width > most_wide:  # pictures of all sizes share one buffer
            mujoco.mjr_resizeOffscreen(max(width, most_wide), max(height, most_high), self._context)
        self._camera.fixedcamid = self._cameras[camera]
        self._option.sitegroup[_EE] = axes
        frame, everything = mujoco.mjtFrame, mujoco.mjtCatBit.mjCAT_ALL
        self._option.frame = frame.mjFRAME_SITE if axes else frame.mjFRAME_NONE
        mujoco.mjv_updateScene(
            self._model, self._data, self._option, None, self._camera, everything, self._scene
        )
        for prop in self._props:
            prop.add_to(self._scene)
        fine = np.empty((height, width, 3), dtype=np.uint8)
        view = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(fine, None, view, self._context)
        # OpenGL counts rows from below
        return np.asarray(Image.fromarray(fine).reduce(_FINER))[::-1].copy()

    def project(self, camera: str, points: F64, aspect: float) -> F32:
        number = self._cameras[camera]
        x, y, back = (
            self._data.cam_xmat[number].reshape(3, 3).T @ (points - self._data.cam_xpos[number]).T
        )
        ahead = np.where(back < 0, -back, np.inf)
        half = ahead * math.tan(math.radians(self._model.cam_fovy[number]) / 2)
        found = np.stack(
            [0.5 + x / (2 * half * aspect), 0.5 - y / (2 * half), np.ones_like(x)], axis=1
        )
        inside = ((found[:, :2] >= 0) & (found[:, :2] <= 1)).all(axis=1) & np.isfinite(ahead)
        return np.where(inside[:, None], found, 0.0).astype(np.float32)
