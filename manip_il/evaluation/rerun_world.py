"""A world in three dimensions, as Rerun shows it from any side; needs no OpenGL where the world is simulated."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.sim.conditions import Drawn
from manip_il.sim.config import Look
from manip_il.sim.variation import drawn_in
from manip_il.sim.view import ViewModel
from manip_il.sim.world import World

ROOT = "world"
_SHOWN_GROUPS = 3  # of geoms; those beyond are for contacts alone
_LEAST_NORMAL = 1e-12
_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)  # of a geom that has none of its own


class WorldLog:
    """Sends the shapes of a world's bodies, and their poses as they move, to a stream of rerun's."""

    def __init__(self, rerun: Any, stream: Any, world: World):
        self._rerun, self._stream, self._world = rerun, stream, world
        scene = world.scene
        self._view = ViewModel(scene.robot.name, scene.task, Look(), scene.shape)
        model, objects = self._view.model, [one.geom for one in scene.objects.values()]
        self._kinds = {geom: int(model.geom_type[geom]) for geom in objects}  # as sent last
        shown = [i for i in range(model.ngeom) if model.geom_group[i] < _SHOWN_GROUPS and _colour(model, i)[3] > 0]
        bodies = {int(model.geom_bodyid[geom]) for geom in shown}
        self._paths = {body: f"{ROOT}/{rerun.escape_entity_path_part(model.body(body).name)}" for body in bodies}
        self._poses: dict[int, bytes] = {}  # of bodies, as sent last
        for geom in shown:
            quaternion = rerun.Quaternion(xyzw=np.roll(model.geom_quat[geom], -1))
            place = rerun.Transform3D(translation=model.geom_pos[geom], quaternion=quaternion)
            stream.log(self._path(geom), place, static=True)
            if geom not in objects and (shape := self._shape(geom)) is not None:
                stream.log(self._path(geom), shape, static=True)

    def add(self, *, first: bool) -> None:
        """Send what has moved since the last call; in an episode's first step everything, the objects' shapes too."""
        world, rerun = self._world, self._rerun
        if first:
            self._poses.clear()
            self._view.apply(Drawn("", drawn_in(world.variation, world.scene.nominal)))
            self._add_objects()
        for body, path in self._paths.items():
            position, quaternion = world.data.xpos[body], world.data.xquat[body]
            pose = position.tobytes() + quaternion.tobytes()
            if self._poses.get(body) != pose:
                self._poses[body] = pose
                turned = rerun.Quaternion(xyzw=np.roll(quaternion, -1))
                self._stream.log(path, rerun.Transform3D(translation=position, quaternion=turned))

    def _add_objects(self) -> None:
        for geom, kind in self._kinds.items():
            if kind != self._view.model.geom_type[geom]:
                self._stream.log(self._path(geom), self._rerun.Clear(recursive=False))
                self._kinds[geom] = int(self._view.model.geom_type[geom])
            self._stream.log(self._path(geom), self._shape(geom))

    def _path(self, geom: int) -> str:
        return f"{self._paths[int(self._view.model.geom_bodyid[geom])]}/{geom}"

    def _shape(self, geom: int) -> Any:
        """Return what rerun draws for a geom; None for a plane, which has no end."""
        rerun, model, kinds = self._rerun, self._view.model, mujoco.mjtGeom
        size = model.geom_size[geom]
        colour = (255 * _colour(model, geom)).astype(np.uint8)
        drawn = {"colors": [colour], "fill_mode": "solid"}
        match int(model.geom_type[geom]):
            case kind if kind == int(kinds.mjGEOM_BOX):
                return rerun.Boxes3D(half_sizes=[size], **drawn)
            case kind if kind == int(kinds.mjGEOM_CYLINDER):
                return rerun.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], **drawn)
            case kind if kind == int(kinds.mjGEOM_CAPSULE):
                below = [[0, 0, -size[1]]]  # rerun's begins at its origin
                return rerun.Capsules3D(radii=[size[0]], lengths=[2 * size[1]], translations=below, **drawn)
            case kind if kind == int(kinds.mjGEOM_SPHERE):
                return rerun.Ellipsoids3D(half_sizes=[[size[0]] * 3], **drawn)
            case kind if kind == int(kinds.mjGEOM_ELLIPSOID):
                return rerun.Ellipsoids3D(half_sizes=[size], **drawn)
            case kind if kind == int(kinds.mjGEOM_MESH):
                return _mesh(rerun, model, int(model.geom_dataid[geom]), colour)
            case _:
                return None


def _mesh(rerun: Any, model: Any, mesh: int, colour: NDArray[np.uint8]) -> Any:
    start, count = model.mesh_faceadr[mesh], model.mesh_facenum[mesh]
    faces = model.mesh_face[start : start + count]
    start = model.mesh_vertadr[mesh]
    vertices = model.mesh_vert[start : start + int(faces.max()) + 1]
    a, b, c = np.moveaxis(vertices[faces], 1, 0)
    normals = np.zeros_like(vertices)
    for corner in range(3):  # a vertex's is the mean of its faces', weighted by area
        np.add.at(normals, faces[:, corner], np.cross(b - a, c - a))
    normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), _LEAST_NORMAL)
    return rerun.Mesh3D(vertex_positions=vertices, triangle_indices=faces, vertex_normals=normals, albedo_factor=colour)


def _colour(model: Any, geom: int) -> NDArray[np.float32]:
    """Red, green, blue and opacity of a geom, (4,), 0 to 1: its own, else its material's, as MuJoCo has it."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    return own if material < 0 or (own != _NO_COLOUR).any() else model.mat_rgba[material]
