"""Pictures of an arm at home in its scene, with its frame `ee`, its cameras and its workspace drawn into them."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.evaluation.film import encode_picture
from manip_il.evaluation.robot_check.joints import at_home
from manip_il.sim.config import CAMERAS, FILM
from manip_il.sim.render import Line, Overview, marked_picture
from manip_il.sim.scene import PREFIX, camera_id
from manip_il.sim.world import Scene

F64 = NDArray[np.float64]
SIZE = (480, 640)  # of a picture [pixels]
_AXES = ((0.85, 0.12, 0.12, 1.0), (0.10, 0.62, 0.20, 1.0), (0.10, 0.30, 0.90, 1.0))  # x red, y green, z blue
_CAMERA = (0.55, 0.20, 0.70, 1.0)
_SPACE = (0.05, 0.45, 0.75, 1.0)
_EE, _CAMERAS_AXES, _FRUSTUM = 0.06, 0.04, 0.12  # lengths of axes, and of a camera's field of view [m]
_THICK, _THIN = 0.0035, 0.0015  # [m]
_UNDERGROUND = -9.0  # [m]
_CLOSER = 0.85  # than a sphere around all that is looked at needs
_FIELD = math.radians(45)  # of a look from outside


@dataclass(frozen=True)
class Look:
    """A picture as JPEG. name: of the camera, or `outside`."""

    name: str
    words: str
    jpeg: bytes


def looks(scene: Scene, name: str) -> tuple[Look, ...]:
    """Return pictures of a scene from outside and by its cameras. name: of the robot, as `get_robot` takes it.

    Raises `RenderError` where there is no off-screen OpenGL.
    """
    data = at_home(scene)
    data.mocap_pos[:, 2] = _UNDERGROUND  # goals
    ee = list(_axes(data.site_xpos[scene.ee_site], data.site_xmat[scene.ee_site], _EE, _THICK))
    near = list(_axes(data.site_xpos[scene.ee_site], data.site_xmat[scene.ee_site], _EE / 2, _THIN))
    space = list(_workspace(scene))
    drawn: dict[str, list[Line]] = {one: [*_axes(*_pose(scene, data, one), _CAMERAS_AXES, _THIN)] for one in CAMERAS}
    fields = {one: [*drawn[one], *_field_of_view(scene, data, one)] for one in CAMERAS}
    views: list[tuple[str, str | Overview, list[Line], str]] = [
        ("outside", _from_outside(scene, data), [*ee, *space, *itertools.chain(*fields.values())], "from outside"),
        ("front", "front", [*ee, *space, *fields["wrist"]], "what camera front sees"),
        ("wrist", "wrist", near, "what camera wrist sees"),
    ]
    return tuple(
        Look(key, words, encode_picture(marked_picture(name, scene.task, data, camera, SIZE, FILM, lines), "jpeg"))
        for key, camera, lines, words in views
    )


def _pose(scene: Scene, data: mujoco.MjData, camera: str) -> tuple[F64, F64]:
    found = camera_id(scene.model, camera)
    return data.cam_xpos[found], data.cam_xmat[found]


def _axes(at: F64, rotation: F64, length: float, thickness: float) -> Iterator[Line]:
    for axis, colour in zip(rotation.reshape(3, 3).T, _AXES, strict=True):
        yield Line(at.copy(), at + length * axis, colour, thickness)


def _field_of_view(scene: Scene, data: mujoco.MjData, camera: str) -> Iterator[Line]:
    """Yield the edges of the pyramid that a camera sees, which looks along its -z."""
    at, rotation = _pose(scene, data, camera)
    up = _FRUSTUM * math.tan(math.radians(scene.model.cam_fovy[camera_id(scene.model, camera)]) / 2)
    across = up * SIZE[1] / SIZE[0]
    corners = [
        at + rotation.reshape(3, 3) @ np.array([x * across, y * up, -_FRUSTUM])
        for x, y in ((1, 1), (1, -1), (-1, -1), (-1, 1))
    ]
    for place, corner in enumerate(corners):
        yield Line(at.copy(), corner, _CAMERA, _THIN)
        yield Line(corner, corners[place - 1], _CAMERA, _THIN)


def _workspace(scene: Scene) -> Iterator[Line]:
    """Yield the edges of the workspace on the table."""
    space = scene.robot.workspace
    (x, y), half = space.centre, space.half_width
    corners = [np.array([x + dx * half, y + dy * half, 0.001]) for dx, dy in ((1, 1), (1, -1), (-1, -1), (-1, 1))]
    for place, corner in enumerate(corners):
        yield Line(corner, corners[place - 1], _SPACE, 2 * _THIN)


def _from_outside(scene: Scene, data: mujoco.MjData) -> Overview:
    """A look that has the whole arm, the workspace and the cameras in it."""
    model = scene.model
    ours = [geom for geom in range(model.ngeom) if model.body(model.geom_bodyid[geom]).name.startswith(PREFIX)]
    seen = [data.geom_xpos[ours], [line.start for line in _workspace(scene)], [_pose(scene, data, "front")[0]]]
    points = np.vstack(seen)
    low, high = points.min(axis=0), points.max(axis=0)
    distance = 0.5 * _CLOSER * float(np.linalg.norm(high - low)) / math.sin(_FIELD / 2)
    return Overview((low + high) / 2, distance, 55.0, -20.0)
