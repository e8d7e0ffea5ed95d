"""The model that pictures are drawn from, and a window that shows it.

The model is a copy of the physics model with few faces, lit by a `Look`. One episode's drawn values
are applied to it and undone for the next. Software rendering costs time per triangle, and the
Panda's meshes have 136,040 for an arm that is 60 pixels tall.

The window is MuJoCo's own viewer, in real time, if there is a display. It shows a copy of the
physics, too: nothing in it affects the episode, except that callers can use the pull of the mouse
(`pull`).
"""

import atexit
import contextlib
import copy
import os
import threading
import time
import warnings
from collections.abc import Sequence
from functools import lru_cache
from operator import attrgetter
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import RenderError
from manip_il.mdp import F64
from manip_il.robots.geometry import turn_about_z
from manip_il.sim.config import CAMERAS, FILM, Look
from manip_il.sim.scene import SCENES_KEPT, STATE_KIND, TABLE, Scene, camera_id
from manip_il.sim.variation import part, seen_objects

Indices = NDArray[np.integer]
_CELLS = 22  # grid cells along a mesh's diagonal: enough to look right at 480 x 640 pixels
# least width of a cell: a pixel at 128 x 128; less if the cameras are nearer [m]
_LEAST_CELL = 0.008
_PLAIN_FACES = 1_600  # meshes with up to this many faces are not simplified
_PULL = 0.01  # weight of a cell's mean, relative to its faces' planes, in placing its vertex
_LEAST_PULL = 1e-12  # [m^2] if a cell has no faces
_LAMPS = tuple(
    lamp + colour
    for lamp in ("light_", "vis.headlight.")
    for colour in ("ambient", "diffuse", "specular")
)
_MOVED = ("cam_pos", "cam_quat", "light_pos", "light_dir")


class ViewModel:
    """A model to draw from, not to simulate.

    Attributes:
        model: The model; every name, address and pose in it is the physics model's.
    """

    def __init__(self, scene: Scene, look: Look, *, fine: bool = False):
        """Copy the scene's model and light it.

        Args:
            scene: The scene.
            look: Lighting.
            fine: Whether to keep every face of the meshes.
        """
        model: Any = copy.copy(scene.model if fine else _with_few_faces(scene))
        model.vis.quality.offsamples = 0  # the renderer smooths edges itself
        if not look.shadows:
            model.vis.quality.shadowsize = 0
        self.model = model
        self._objects = [one.geom for one in scene.objects.values()]
        self._lamps = attrgetter(*_LAMPS)(model)
        self._light(look.brightness, look.light_turn)
        changed = attrgetter("geom_type", "geom_size", "geom_matid", "geom_rgba", *_MOVED)(model)
        self._plain = [(array, array.copy()) for array in (*changed, *self._lamps)]
        self._applied = scene.nominal

    def apply(self, variation: F64) -> None:
        """Apply the look of a variation to the next pictures.

        Nothing is uploaded to the graphics card.

        Args:
            variation: The variation, (v,).
        """
        if np.array_equal(variation, self._applied):
            return
        for array, plain in self._plain:
            array[:] = plain
        sizes, kind = seen_objects(variation)
        self.model.geom_size[self._objects] = sizes
        if kind is not None:
            self.model.geom_type[self._objects] = kind
        self._paint(self._objects, part(variation, "colour"))
        self._paint([self.model.geom(TABLE).id], part(variation, "table"))
        shifts, turns = (
            part(variation, name).reshape(-1, 3) for name in ("camera_shift", "camera_turn")
        )
        for name, shift, turn in zip(CAMERAS, shifts, np.deg2rad(turns), strict=True):
            camera, moved = camera_id(self.model, name), np.empty(3)
            quat = self.model.cam_quat[camera]
            mujoco.mju_rotVecQuat(moved, shift, quat)
            self.model.cam_pos[camera] += moved
            mujoco.mju_quatIntegrate(quat, turn, 1.0)
        brightness, light_turn = part(variation, "brightness"), part(variation, "light_turn")
        self._light(*brightness.tolist(), *light_turn.tolist())
        self._applied = variation.copy()

    def _paint(self, geoms: Sequence[int], colour: F64) -> None:
        if (colour >= 0).all():
            self.model.geom_matid[geoms] = -1  # a material's colour would hide the geom's
            self.model.geom_rgba[geoms] = [*colour, 1.0]

    def _light(self, brightness: float, light_turn: float) -> None:
        """Multiply every lamp by a factor, and turn those fixed in the world about the vertical
        [deg].
        """
        for colour in self._lamps:
            colour *= brightness
        rotation = turn_about_z(np.deg2rad(light_turn))
        in_world = self.model.light_bodyid == 0
        for vectors in (self.model.light_pos, self.model.light_dir):
            vectors[in_world] = vectors[in_world] @ rotation.T


@lru_cache(SCENES_KEPT)
def _with_few_faces(scene: Scene) -> mujoco.MjModel:
    model = copy.copy(scene.model)
    simplify_meshes(model, scene.scale * _LEAST_CELL)
    return model


def simplify_meshes(model: mujoco.MjModel, finest: float) -> None:
    """Reduce the faces of large meshes in a model that is only drawn.

    Args:
        model: The model, changed in place.
        finest: Least size of a grid cell [m].
    """
    for mesh in np.flatnonzero(model.mesh_facenum > _PLAIN_FACES):
        vertices, normals, faces, face_normals = (
            getattr(model, f"mesh_{rows}")[start:][:count]
            for rows, start, count in (
                ("vert", model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]),
                ("normal", model.mesh_normaladr[mesh], model.mesh_normalnum[mesh]),
                ("face", model.mesh_faceadr[mesh], model.mesh_facenum[mesh]),
                ("facenormal", model.mesh_faceadr[mesh], model.mesh_facenum[mesh]),
            )
        )
        normal_of = np.zeros(len(vertices), dtype=np.int64)
        normal_of[faces] = face_normals
        positions, originals, few = cluster(vertices.astype(np.float64), faces, finest)
        # Their start is overwritten; the rest is never drawn.
        vertices[: len(positions)] = positions
        normals[: len(positions)] = normals[normal_of[originals]]
        faces[: len(few)] = face_normals[: len(few)] = few
        model.mesh_facenum[mesh] = len(few)


def cluster(
    vertices: F64, faces: Indices, finest: float = _LEAST_CELL
) -> tuple[F64, Indices, Indices]:
    """Merge the vertices of a mesh that share a grid cell.

    The original of a cell is the vertex nearest to the mean of its vertices; the original's normal
    shades the coarse mesh like the fine one.

    Args:
        vertices: Positions of the vertices, (v, 3) [m].
        faces: Indices of the vertices of each triangle, (f, 3).
        finest: Least size of a cell [m].

    Returns:
        Positions of the merged vertices, (c, 3) [m]; indices of their originals, (c,); and the
        faces that are left, which index the merged vertices, at most f.
    """
    low, high = vertices.min(axis=0), vertices.max(axis=0)
    size = max(float(np.linalg.norm(high - low)) / _CELLS, finest)
    grid = ((vertices - low) / size).astype(np.int64)
    _, cell, counts = np.unique(grid, axis=0, return_inverse=True, return_counts=True)
    means = _sums(cell, vertices, len(counts)) / counts[:, None]
    moves = _flattest(vertices, faces, cell, means) - means
    # by a cell's size at most
    moves *= size / np.maximum(np.linalg.norm(moves, axis=1, keepdims=True), size)
    by_distance = np.lexsort([np.linalg.norm(vertices - means[cell], axis=1), cell])
    originals = by_distance[np.cumsum(counts) - counts]
    # faces with three different corners, each once, in their winding
    merged = cell[faces]
    merged = merged[(merged != np.roll(merged, 1, axis=1)).all(axis=1)]
    turned = (merged.argmin(axis=1)[:, None] + [0, 1, 2]) % 3
    return means + moves, originals, np.unique(np.take_along_axis(merged, turned, 1), axis=0)


def _flattest(vertices: F64, faces: Indices, cell: Indices, means: F64) -> F64:
    """Points with least squared distances to the planes of a cell's faces, weighted by area: sharp
    edges stay.

    After P. Lindstrom, Out-of-core simplification of large polygonal models (2000).
    """
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.cross(b - a, c - a)
    areas = np.linalg.norm(normals, axis=1, keepdims=True)
    normals /= np.maximum(areas, _LEAST_PULL)
    matrices = (areas[:, :, None] * normals[:, :, None] * normals[:, None, :]).reshape(-1, 9)
    rights = areas * normals * (normals * a).sum(axis=1, keepdims=True)
    # A face counts in the cells of its three corners.
    corners, face = cell[faces].ravel(), np.arange(len(faces)).repeat(3)
    matrix = _sums(corners, matrices[face], len(means)).reshape(-1, 3, 3)
    right = _sums(corners, rights[face], len(means))
    pull = _PULL * np.trace(matrix, axis1=1, axis2=2)[:, None] + _LEAST_PULL
    return np.linalg.solve(
        matrix + pull[:, :, None] * np.eye(3), (right + pull * means)[:, :, None]
    )[:, :, 0]


def _sums(groups: Indices, values: F64, count: int) -> F64:
    """Sums of the rows of each group, (count, d)."""
    sums = np.zeros((count, values.shape[1]))
    np.add.at(sums, groups, values)
    return sums


DISPLAYS = ("DISPLAY", "WAYLAND_DISPLAY")  # variables of X11 and Wayland
# initial camera: target's height [m], [m], [deg]
_LOOK_AT = 0.15
_DISTANCE = 1.9
_AZIMUTH = 140.0
_ELEVATION = -25.0
_CLOSING = 5.0  # longest wait for each of the viewer's threads [s]


def has_display() -> bool:
    """Return whether an environment variable names a display."""
    return any(os.environ.get(name) for name in DISPLAYS)


def require_display() -> None:
    """Check that a window can be opened.

    Without this, MuJoCo's viewer would end the process, or wait forever.

    Raises:
        RenderError: If no window can be opened.
    """
    import glfw  # MuJoCo's own

    with warnings.catch_warnings(action="ignore"):  # glfw warns if there is no display
        opened = has_display() and glfw.init()
    if not opened:
        named = ", ".join(f"{name}={os.environ.get(name, '')}" for name in DISPLAYS)
        raise RenderError(f"no display: {named}; write a file: manip-il view --output=FILE.rrd")


_CATCH_UP = 0.03  # most time that a clock makes up for [s]


class Clock:
    """Paces steps in real time."""

    def __init__(self, hz: float):
        self._step, self._due = 1 / hz, 0.0

    def wait(self) -> None:
        """Wait until a step has passed since the last one was due.

        Return at once if it already has; steps that were a little late are made up for.
        """
        now = time.monotonic()
        self._due = max(self._due + self._step, now - _CATCH_UP)
        time.sleep(max(0.0, self._due - now))


class Window:
    """A window that shows a scene in real time."""

    def __init__(self, scene: Scene, control_hz: float):
        """Open the window.

        Args:
            scene: The scene.
            control_hz: How often per second `show` is called.

        Raises:
            RenderError: If there is no display.
        """
        require_display()
        import mujoco.viewer

        self._view = ViewModel(scene, FILM, fine=True)
        self._model, self._data = self._view.model, mujoco.MjData(self._view.model)
        self._state = np.empty(mujoco.mj_stateSize(self._model, STATE_KIND))
        self._clock = Clock(control_hz)
        others = threading.enumerate()
        self._handle: Any = mujoco.viewer.launch_passive(
            self._model, self._data, show_left_ui=False, show_right_ui=False
        )
        self._threads = [one for one in threading.enumerate() if one not in others]
        # before MuJoCo's own handlers, which do not wait for its threads and may crash
        atexit.register(self.close)
        with self._handle.lock():
            camera = self._handle.cam
            camera.lookat[:] = [*scene.robot.workspace.centre, _LOOK_AT]
            camera.distance = _DISTANCE
            camera.azimuth = _AZIMUTH
            camera.elevation = _ELEVATION

    @property
    def is_open(self) -> bool:
        """Whether the window is open: false once the user has closed it."""
        return self._handle.is_running()

    def show(self, data: mujoco.MjData, variation: F64, text: str = "") -> None:
        """Show the physics, then wait for real time; do nothing if the window is closed.

        Args:
            data: The scene's data.
            variation: The world's variation, (v,), whose look is shown.
            text: Text shown in the upper left.
        """
        if not self.is_open:
            return
        with self._handle.lock():
            self._view.apply(variation)
            mujoco.mj_getState(self._model, data, self._state, STATE_KIND)
            mujoco.mj_setState(self._model, self._data, self._state, STATE_KIND)
            mujoco.mj_forward(self._model, self._data)
        with contextlib.suppress(mujoco.UnexpectedError):  # closed meanwhile
            if text:
                self._handle.set_texts((None, None, text, ""))
            self._handle.sync()
        self._clock.wait()

    def pull(self, data: mujoco.MjData) -> None:
        """Apply the mouse's pull on a body [N] to `data`, until the next call."""
        data.xfrc_applied[:] = 0.0
        mujoco.mjv_applyPerturbForce(self._model, data, self._handle.perturb)

    def close(self) -> None:
        """Close the window and wait until it is gone; a second call changes nothing."""
        atexit.unregister(self.close)
        self._handle.close()
        for one in self._threads:
            one.join(_CLOSING)
