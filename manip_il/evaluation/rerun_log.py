"""Episodes as Rerun shows them, live or from a file: the world in 3-D, pictures, joints, actions, phase, outcomes.

Entities have the names of a dataset's columns.
"""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.environments import env_spec
from manip_il.data import schema
from manip_il.errors import ManipError
from manip_il.evaluation.watch import outcome
from manip_il.mdp import Transition
from manip_il.sim.conditions import Drawn
from manip_il.sim.config import CAMERAS, EnvConfig, Look
from manip_il.sim.scene import build_scene
from manip_il.sim.variation import drawn_in
from manip_il.sim.view import ViewModel
from manip_il.sim.window import Clock
from manip_il.sim.world import World
from manip_il.tasks.table import get_task

ROOT, ERROR, EVENTS = "world", "error", "events"
TIME, FRAME = "time", "frame"  # timelines: [s] and control steps since the first episode began
_NO_RERUN = "rerun is not installed; run: pip install 'rerun-sdk>=0.33,<0.34'"
_JPEG_QUALITY = 90
_SHOWN_GROUPS = 3  # of geoms; those beyond are for contacts alone
_NO_COLOUR = (0.5, 0.5, 0.5, 1.0)  # of a geom that has none of its own


class RerunLog:
    """Steps of episodes, sent to a file, or in real time to whoever opens `address`.

    address: of the viewer, for a browser; empty if a file is written. ports: of the viewer and the stream.
    Raises `ManipError` without rerun, `OSError` if the file cannot be written.
    """

    act = None  # nobody drives by it

    def __init__(self, env: EnvConfig, output: Path | None = None):
        try:
            import rerun
        except ImportError as error:
            raise ManipError(_NO_RERUN) from error
        if output:
            output.open("wb").close()  # first: rerun adds lines of its own if it cannot write
        self._rerun: Any = rerun
        self._env, self._task, self._spec = env, get_task(env.task, env.object), env_spec(env)
        self._world = World(build_scene(env.robot, env.task, env.object, env.physics_step))
        self._clock = None if output else Clock(env.control_hz)
        self._frames, self._phase = 0, ""
        self._stream: Any = rerun.RecordingStream("manip_il")
        self.address, self.ports = "", (0, 0)
        if output:
            self._stream.save(output, default_blueprint=_blueprint())
        else:
            self.ports = web, grpc = _free_port(9090), _free_port(9876)  # Rerun's own, if they are free
            uri = self._stream.serve_grpc(grpc_port=grpc, default_blueprint=_blueprint())
            self._rerun.serve_web_viewer(web_port=web, open_browser=False, connect_to=uri)
            self.address = f"http://localhost:{web}/?url=rerun%2Bhttp://localhost:{grpc}/proxy"
        for name in (schema.STATE, schema.ACTION, schema.EXECUTED_ACTION):
            self._stream.log(name, rerun.SeriesLines(names=self._spec.joint_names), static=True)
        self._shapes = _Shapes(rerun, self._stream, self._world)

    def add(self, step: Transition) -> bool:
        """Send a step; live, then wait for real time. Returns True: there is always more room."""
        rerun, stream = self._rerun, self._stream
        stream.set_time(TIME, duration=self._frames / self._env.control_hz)
        stream.set_time(FRAME, sequence=self._frames)
        self._frames += 1
        if step.step == 0:
            self._phase = ""
            self._say(f"seed {step.seed}: {step.observation.instruction or self._task.instruction}")
        for camera, picture in step.observation.images.items():
            stream.log(schema.IMAGES + camera, rerun.Image(picture).compress(jpeg_quality=_JPEG_QUALITY))
        self._world.restore(step.state.physics, step.state.variation)
        numbers = {
            schema.STATE: step.observation.state,
            schema.EXECUTED_ACTION: step.executed_action,
            schema.PROGRESS: step.progress,
            ERROR: self._task.error(self._world),
        }
        if step.label is not None:
            numbers[schema.ACTION] = step.label.action
            if (phase := self._spec.phases[step.label.phase]) != self._phase:
                stream.log(schema.EXPERT_PHASE, rerun.StateChange(state=phase))
                self._phase = phase
        for name, value in numbers.items():
            stream.log(name, rerun.Scalars(value))
        self._shapes.send(first=step.step == 0)
        if step.done:
            self._say(outcome(step))
        if self._clock is not None:
            self._clock.wait()
        return True

    def close(self) -> None:
        """Write or send what is still waiting."""
        self._stream.flush()
        self._stream.disconnect()

    def _say(self, text: str) -> None:
        self._stream.log(EVENTS, self._rerun.TextLog(text))


class _Shapes:
    """The shapes of a world's bodies, and their poses as they move; needs no OpenGL."""

    def __init__(self, rerun: Any, stream: Any, world: World):
        self._rerun, self._stream, self._world = rerun, stream, world
        scene = world.scene
        self._view = ViewModel(scene.robot.name, scene.task, Look(), scene.shape)
        model = self._view.model
        self._objects = {one.geom for one in scene.objects.values()}  # which episodes draw anew
        shown = [i for i in range(model.ngeom) if model.geom_group[i] < _SHOWN_GROUPS and _colour(model, i)[3] > 0]
        bodies = {int(model.geom_bodyid[geom]) for geom in shown}
        self._paths = {body: f"{ROOT}/{rerun.escape_entity_path_part(model.body(body).name)}" for body in bodies}
        for geom in shown:
            stream.log(self._path(geom), self._pose(model.geom_pos[geom], model.geom_quat[geom]), static=True)
            if geom not in self._objects and (shape := self._shape(geom)) is not None:
                stream.log(self._path(geom), shape, static=True)

    def send(self, *, first: bool) -> None:
        """Send where every body is; in an episode's first step the objects' shapes, too."""
        world = self._world
        if first:
            self._view.apply(Drawn("", drawn_in(world.variation, world.scene.nominal)))
            for geom in self._objects:
                self._stream.log(self._path(geom), self._rerun.Clear(recursive=False))
                self._stream.log(self._path(geom), self._shape(geom))
        for body, path in self._paths.items():
            self._stream.log(path, self._pose(world.data.xpos[body], world.data.xquat[body]))

    def _path(self, geom: int) -> str:
        return f"{self._paths[int(self._view.model.geom_bodyid[geom])]}/{geom}"

    def _pose(self, position: NDArray[Any], quaternion: NDArray[Any]) -> Any:
        turned = self._rerun.Quaternion(xyzw=np.roll(quaternion, -1))
        return self._rerun.Transform3D(translation=position, quaternion=turned)

    def _shape(self, geom: int) -> Any:
        """What rerun draws for a geom; None for a plane, which has no end."""
        rerun, model, kinds = self._rerun, self._view.model, mujoco.mjtGeom
        size, kind = model.geom_size[geom], mujoco.mjtGeom(int(model.geom_type[geom]))
        colour = (255 * _colour(model, geom)).astype(np.uint8)
        drawn = {"colors": [colour], "fill_mode": "solid"}
        if kind == kinds.mjGEOM_BOX:
            return rerun.Boxes3D(half_sizes=[size], **drawn)
        if kind == kinds.mjGEOM_CYLINDER:
            return rerun.Cylinders3D(radii=[size[0]], lengths=[2 * size[1]], **drawn)
        if kind == kinds.mjGEOM_CAPSULE:  # rerun's begins at its origin
            below = [[0, 0, -size[1]]]
            return rerun.Capsules3D(radii=[size[0]], lengths=[2 * size[1]], translations=below, **drawn)
        if kind in (kinds.mjGEOM_SPHERE, kinds.mjGEOM_ELLIPSOID):
            radii = [size[0]] * 3 if kind == kinds.mjGEOM_SPHERE else size
            return rerun.Ellipsoids3D(half_sizes=[radii], **drawn)
        if kind != kinds.mjGEOM_MESH:
            return None
        mesh = model.mesh(int(model.geom_dataid[geom]))
        start, count = int(mesh.faceadr[0]), int(mesh.facenum[0])
        faces = model.mesh_face[start : start + count]
        corners = model.mesh_vert[int(mesh.vertadr[0]) :][faces].reshape(-1, 3)  # each face has its own: flat, and lit
        sides = corners.reshape(-1, 3, 3)
        normals = np.cross(sides[:, 1] - sides[:, 0], sides[:, 2] - sides[:, 0])
        normals /= np.maximum(np.linalg.norm(normals, axis=1, keepdims=True), 1e-12)
        return rerun.Mesh3D(
            vertex_positions=corners, vertex_normals=np.repeat(normals, 3, axis=0), albedo_factor=colour
        )


def _blueprint() -> Any:
    import rerun.blueprint as layout

    no_legend = layout.PlotLegend(visible=False)
    curves = [
        layout.StateTimelineView(origin=schema.EXPERT_PHASE, name="phase"),
        layout.TimeSeriesView(contents=[schema.PROGRESS, ERROR], name="progress, error [m]"),
        layout.TimeSeriesView(origin=schema.STATE, name="joints and gripper", plot_legend=no_legend),
        layout.TimeSeriesView(origin=schema.EXECUTED_ACTION, name="executed action", plot_legend=no_legend),
        layout.TextLogView(origin=EVENTS, name="episodes"),
    ]
    pictures = layout.Horizontal(*(layout.Spatial2DView(origin=schema.IMAGES + name, name=name) for name in CAMERAS))
    world = layout.Vertical(layout.Spatial3DView(origin=ROOT, name="world"), pictures, row_shares=[3, 2])
    return layout.Blueprint(
        layout.Horizontal(world, layout.Vertical(*curves, row_shares=[1, 2, 2, 2, 1])),
        layout.TimePanel(timeline=TIME, state="collapsed"),
        layout.SelectionPanel(state="hidden"),
        layout.BlueprintPanel(state="collapsed"),
    )


def _colour(model: Any, geom: int) -> NDArray[np.float32]:
    """Red, green, blue and opacity of a geom, (4,), 0 to 1: its own, else its material's, as MuJoCo has it."""
    own, material = model.geom_rgba[geom], int(model.geom_matid[geom])
    return own if material < 0 or (own != _NO_COLOUR).any() else model.mat_rgba[material]


def _free_port(wanted: int) -> int:
    """A port on which nobody listens: the wanted one, or any other."""
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(("", wanted))
        except OSError:
            one.bind(("", 0))
        return one.getsockname()[1]
