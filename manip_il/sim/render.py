"""Off-screen pictures of a simulator state, and where they show the scene's named keypoints.

Pictures also show objects without contact: the stand of a goal, and clutter around the workspace.
There is one OpenGL context per thread, for any number of environments.
"""

from __future__ import annotations

import atexit
import math
import os
import weakref
from collections.abc import Sequence
from functools import lru_cache
from importlib import import_module
from itertools import product
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.caching import cached_per_thread
from manip_il.errors import RenderError
from manip_il.mdp import F32, F64
from manip_il.robots.geometry import turn_about_z
from manip_il.seeding import rng_for
from manip_il.sim.config import CAMERAS, CameraConfig, Look
from manip_il.sim.scene import SCENES_KEPT, camera_id
from manip_il.sim.variation import part
from manip_il.sim.view import ViewModel
from manip_il.sim.world import GOAL, Scene, World

LOOK_VERSION = 3  # of objects without contact, part of the fingerprint of pictures
_POLE, _SHORTEST = 0.003, 0.03  # radius of a goal's pole, and its least height [m]
# radius of a goal's foot, half the length of its cross, in radii of the largest object
_FOOT, _ARM = 1.2, 1.6
_THIN, _GOAL = 0.001, 0.02  # height of a foot, radius of a goal [m]
_UP = np.eye(3)
_ACROSS = (
    np.array([[0.0, 0, 1], [0, 1, 0], [-1, 0, 0]]),
    np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]]),
)  # rotations that turn z along x, and along y
_STAND = (0.10, 0.55, 0.28, 1.0)  # the stand's colour
_KINDS = (mujoco.mjtGeom.mjGEOM_BOX, mujoco.mjtGeom.mjGEOM_CYLINDER, mujoco.mjtGeom.mjGEOM_SPHERE)
# range of a clutter object's half lengths, for a workspace as large as Panda's [m]
_HALF = (0.012, 0.04)
# least and greatest distance of clutter from the workspace's edge [m]
_BESIDE, _WITHIN = 0.06, 0.24
_FROM_BASE = 0.18  # least horizontal distance of clutter from the robot's first joint [m]
_DRAWS = 50  # draws of a clutter object's place before it is left out


class Prop(NamedTuple):
    """An object to draw.

    Attributes:
        kind: MuJoCo's geom type.
        size: MuJoCo's size of such a geom, (3,) [m].
        position: Its position in the world, (3,) [m].
        rotation: Its rotation, (3, 3).
        colour: Red, green, blue and opacity.
    """

    kind: int
    size: F64
    position: F64
    rotation: F64
    colour: tuple[float, float, float, float]

    def add_to(self, scene: Any) -> None:
        """Add the object to `scene`, MuJoCo's list of geoms to draw next."""
        geom, (*shape, rotation, colour) = scene.geoms[scene.ngeom], self
        mujoco.mjv_initGeom(geom, *shape, rotation.ravel(), np.array(colour, np.float32))
        geom.category = mujoco.mjtCatBit.mjCAT_STATIC
        scene.ngeom += 1


def props(scene: Scene, data: mujoco.MjData, clutter: Sequence[float] | F64 = (0, 0)) -> list[Prop]:
    """Return the visual objects of a scene's world.

    Args:
        scene: The scene.
        data: Its data, with up-to-date poses of mocap bodies and joints.
        clutter: Largest number of clutter objects, and the seed of their kinds and places, (2,).
    """
    return [*_stand(scene, data), *_clutter(scene, data, int(clutter[0]), int(clutter[1]))]


def _stand(scene: Scene, data: mujoco.MjData) -> list[Prop]:
    """The stand of a goal, wider than an object there: a foot on the table, or a pole with a
    cross in the air.
    """
    body = mujoco.mj_name2id(scene.model, mujoco.mjtObj.mjOBJ_BODY, GOAL)
    if body < 0:
        return []
    x, y, z = data.mocap_pos[scene.model.body_mocapid[body]].tolist()
    if z < 0:
        return []
    scale = scene.scale
    largest = max(
        (float(scene.model.geom_rbound[one.geom]) for one in scene.objects.values()),
        default=_GOAL * scale,
    )
    if z <= _SHORTEST:
        parts = [(_FOOT * largest, _THIN, _THIN / 2, _UP)]
    else:
        arms = [(_POLE * scale, 2 * _ARM * largest, z, along) for along in _ACROSS]
        parts = [(_POLE * scale, z, z / 2, _UP), *arms]
    kind = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
    return [
        Prop(kind, np.array([radius, length / 2, 0.0]), np.array([x, y, up]), rotation, _STAND)
        for radius, length, up, rotation in parts
    ]


def _clutter(scene: Scene, data: mujoco.MjData, count: int, seed: int) -> list[Prop]:
    if not count:
        return []
    rng, radii = rng_for(seed, "clutter"), scene.model.geom_rbound
    taken = [(data.geom_xpos[geom][:2].tolist(), float(radii[geom])) for geom in scene.furniture]
    found: list[Prop] = []
    for _ in range(count):
        prop, radius, height = _thing(rng, scene)
        for _ in range(_DRAWS):
            at = _place(rng, scene, data)
            if at and all(math.dist(at, other) > radius + its for other, its in taken):
                taken.append((at, radius))
                found.append(prop._replace(position=np.array([*at, height])))
                break
    return found


def _thing(rng: np.random.Generator, scene: Scene) -> tuple[Prop, float, float]:
    """A box, cylinder or ball of any colour, turned about the vertical.

    Its radius from above, half its height [m].
    """
    number = int(rng.integers(len(_KINDS)))
    x, y, z = (rng.uniform(*_HALF, 3) * scene.scale).tolist()
    size, radius, height = (
        ((x, y, z), math.hypot(x, y), z),
        ((x, z, 0.0), x, z),
        ((x, 0.0, 0.0), x, x),
    )[number]
    rotation, colour = turn_about_z(rng.uniform(-np.pi, np.pi)), rng.uniform(0.05, 0.95, 3)
    prop = Prop(int(_KINDS[number]), np.array(size), np.zeros(3), rotation, (*colour, 1.0))
    return prop, radius, height


def _place(rng: np.random.Generator, scene: Scene, data: mujoco.MjData) -> list[float]:
    """A random place on the table around the workspace.

    [] if it is in the workspace or near the robot's base.
    """
    space = scene.robot.workspace
    outer = space.half_width + _WITHIN
    x, y = rng.uniform(-outer, outer, 2).tolist()
    if max(abs(x), abs(y)) < space.half_width + _BESIDE:
        return []
    at = [space.centre[0] + x, space.centre[1] + y]
    return at if math.dist(at, data.xanchor[scene.shoulder][:2].tolist()) > _FROM_BASE else []


Picture = NDArray[np.uint8]
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
# if no picture can be rendered
REMEDY = f"unset MUJOCO_GL if it is set; on Debian: apt-get install -y {PACKAGES}"
_FINER = 2  # supersampling each way: cheaper than OpenGL's antialiasing, which redraws the meshes
_MAX_GEOMS = 10_000
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
    renderer = _prepared(scene, cameras.look)
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
    renderer = _prepared(scene, cameras.look)
    return {
        name: renderer.project(name, points, cameras.width / cameras.height)
        for name in cameras.names
    }


def close() -> None:
    """Free this thread's OpenGL context; the next picture makes another."""
    if _context.own.cache_info().currsize:
        gl = _context()
        gl.make_current()
        for canvas in list(gl.canvases):
            canvas.free()
        gl.free()
        _context.own.cache_clear()


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
    gl.canvases = weakref.WeakSet()
    atexit.register(close)
    return gl


@cached_per_thread(1)
def _prepared(scene: Scene, look: Look) -> _Renderer:
    return _Renderer(scene, look)


class Canvas:
    """Draws one model, in pictures of any size, in this thread's OpenGL context.

    Args:
        model: The model to draw, in which its lamps and the size of its shadow map are set.

    Raises:
        RenderError: If there is no off-screen OpenGL; it says what to unset or install.
    """

    def __init__(self, model: mujoco.MjModel):
        self.model: Any = model
        self.data: Any = mujoco.MjData(model)
        self._scene: Any = mujoco.MjvScene(model, _MAX_GEOMS)
        self._option, self._camera = mujoco.MjvOption(), mujoco.MjvCamera()
        self._camera.type = mujoco.mjtCamera.mjCAMERA_FIXED
        self._context: Any = None
        self._enter()

    def _enter(self) -> None:
        """Draw into this canvas from now on, whatever else has drawn since."""
        try:
            gl = _context()
            gl.make_current()
            if self._context is None:
                self._context = mujoco.MjrContext(self.model, mujoco.mjtFontScale.mjFONTSCALE_100)
                gl.canvases.add(self)
            mujoco.mjr_setBuffer(mujoco.mjtFramebuffer.mjFB_OFFSCREEN, self._context)
            if self._context.currentBuffer != mujoco.mjtFramebuffer.mjFB_OFFSCREEN:
                raise RuntimeError("the context has no off-screen buffers")
        except Exception as error:  # mujoco raises many kinds of errors, from ImportError on
            raise RenderError(
                f"no off-screen OpenGL ({type(error).__name__}: {error}); {REMEDY}"
            ) from error

    def free(self) -> None:
        """Free what the current OpenGL context holds of the canvas. It is made again if needed."""
        self._context.free()
        self._context = None

    def pose(self, data: mujoco.MjData) -> None:
        """Take the poses from `data`."""
        self.data.qpos[:] = data.qpos
        self.data.mocap_pos[:], self.data.mocap_quat[:] = data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_camlight(self.model, self.data)
        mujoco.mj_tendon(self.model, self.data)

    def picture(
        self, camera: int, size: tuple[int, int], props: Sequence[Prop] = (), *, axes: bool = False
    ) -> Picture:
        """Return a picture, (height, width, 3).

        Args:
            camera: Number of the camera in the model.
            size: Height and width [pixels].
            props: Objects that are not in the model.
            axes: Whether to draw the axes of the site `ee`.
        """
        self._enter()
        height, width = (_FINER * side for side in size)
        most_wide, most_high = self._context.offWidth, self._context.offHeight
        if height > most_high or width > most_wide:  # pictures of all sizes share one buffer
            mujoco.mjr_resizeOffscreen(max(width, most_wide), max(height, most_high), self._context)
        self._camera.fixedcamid = camera
        self._option.sitegroup[_EE] = axes
        frame, everything = mujoco.mjtFrame, mujoco.mjtCatBit.mjCAT_ALL
        self._option.frame = frame.mjFRAME_SITE if axes else frame.mjFRAME_NONE
        mujoco.mjv_updateScene(
            self.model, self.data, self._option, None, self._camera, everything, self._scene
        )
        for prop in props:
            prop.add_to(self._scene)
        fine = np.empty((height, width, 3), dtype=np.uint8)
        view = mujoco.MjrRect(0, 0, width, height)
        mujoco.mjr_render(view, self._scene, self._context)
        mujoco.mjr_readPixels(fine, None, view, self._context)
        # OpenGL counts rows from below
        return np.asarray(Image.fromarray(fine).reduce(_FINER))[::-1].copy()

    def project(self, camera: int, points: F64, aspect: float) -> F32:
        """Return where points (K, 3) [m] are in a camera's pictures, (K, 3), as `projections`."""
        x, y, back = (
            self.data.cam_xmat[camera].reshape(3, 3).T @ (points - self.data.cam_xpos[camera]).T
        )
        ahead = np.where(back < 0, -back, np.inf)
        half = ahead * math.tan(math.radians(self.model.cam_fovy[camera]) / 2)
        found = np.stack(
            [0.5 + x / (2 * half * aspect), 0.5 - y / (2 * half), np.ones_like(x)], axis=1
        )
        inside = ((found[:, :2] >= 0) & (found[:, :2] <= 1)).all(axis=1) & np.isfinite(ahead)
        return np.where(inside[:, None], found, 0.0).astype(np.float32)


class _Renderer:
    """Draws one scene in one look, with the objects without contact."""

    def __init__(self, scene: Scene, look: Look):
        self._of, self._view = scene, ViewModel(scene, look)
        scale = self._view.model.vis.scale
        scale.framelength, scale.framewidth = np.array(_AXES) / self._view.model.stat.meansize
        self._canvas, self._props = Canvas(self._view.model), list[Prop]()
        self._cameras = {name: camera_id(self._view.model, name) for name in CAMERAS}

    def pose(self, data: mujoco.MjData, variation: F64) -> None:
        """Take the poses from `data`, and apply the look of a variation (v,)."""
        self._view.apply(variation)
        self._canvas.pose(data)
        self._props = props(self._of, self._canvas.data, part(variation, "clutter"))

    def picture(self, camera: str, size: tuple[int, int], *, axes: bool) -> Picture:
        return self._canvas.picture(self._cameras[camera], size, self._props, axes=axes)

    def project(self, camera: str, points: F64, aspect: float) -> F32:
        return self._canvas.project(self._cameras[camera], points, aspect)


_SIGNS = np.array(list(product((-1, 1), repeat=3)))  # signs of a box's corners
_NAMED = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_SITE)
_CORNERS = 4  # a box's upper corners, which cameras see


def points_in(world: World) -> dict[str, F64]:
    """Return the keypoints: name -> position (3,) [m].

    A vector that the task observes is a keypoint if it has the name of a body, geom or site. The
    upper corners of a box are numbered by their direction from its centre, seen from above.
    """
    model = world.scene.model
    found = {
        name: np.asarray(value)
        for name, value in world.scene.task.observe(world).items()
        if np.ndim(value) and any(mujoco.mj_name2id(model, kind, name) >= 0 for kind in _NAMED)
    }
    for name, one in world.scene.objects.items():
        if model.geom_type[one.geom] == mujoco.mjtGeom.mjGEOM_BOX:
            found |= {
                f"{name}.corner_{number}": at
                for number, at in enumerate(_upper_corners(world, name))
            }
    return found


@lru_cache(SCENES_KEPT)
def point_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of `points_in`, in its order."""
    world = World(scene)
    world.update()
    return tuple(points_in(world))


def _upper_corners(world: World, name: str) -> F64:
    """The upper corners (4, 3) [m] of a box."""
    pose, half = world.pose(name), np.asarray(world.extents(name)) / 2
    around = (_SIGNS * half) @ pose.rotation.T
    upper = around[np.argsort(around[:, 2], kind="stable")[-_CORNERS:]]
    return pose.position + upper[np.argsort(np.arctan2(upper[:, 1], upper[:, 0]), kind="stable")]
