"""Episodes as Rerun shows them, live or from a file: pictures, joints, actions, phase, error and progress, outcomes.

Entities have the names of a dataset's columns.
"""

from __future__ import annotations

import socket
from pathlib import Path
from typing import Any

from manip_il.collect.environments import env_spec
from manip_il.data import schema
from manip_il.errors import ManipError
from manip_il.evaluation.rerun_world import ROOT, WorldLog
from manip_il.evaluation.watch import outcome
from manip_il.mdp import Transition
from manip_il.sim.config import CAMERAS, EnvConfig
from manip_il.sim.scene import build_scene
from manip_il.sim.window import Clock
from manip_il.sim.world import World
from manip_il.tasks.table import get_task

APPLICATION = "manip_il"
ERROR, EVENTS = "error", "events"
TIME, FRAME = "time", "frame"  # timelines: [s] and control steps since the first episode began
NO_RERUN = "rerun is not installed; run: pip install 'rerun-sdk>=0.33,<0.34'"
_WEB_PORT, _GRPC_PORT = 9090, 9876  # Rerun's own
_JPEG_QUALITY = 90


class RerunLog:
    """Steps of episodes, sent to a file, or in real time to whoever opens `address`.

    Raises `ManipError` without rerun, `OSError` where the file cannot be written.
    """

    act = None  # nobody drives by it

    def __init__(self, env: EnvConfig, output: Path | None = None):
        self._rerun: Any = _import_rerun()
        if output:
            output.open("wb").close()  # first: rerun adds lines of its own where it cannot write
        self._env, self._task = env, get_task(env.task, env.object)
        self._spec = env_spec(env)
        self._world = World(build_scene(env.robot, env.task, env.object, env.physics_step))
        self._clock = None if output else Clock(env.control_hz)
        self._frames, self._phase = 0, ""
        self._stream = self._rerun.RecordingStream(APPLICATION)
        self.web_port, self.grpc_port = (0, 0) if output else self._serve()
        if output:
            self._stream.save(output, default_blueprint=self._blueprint())
        self._name_curves()
        self._in_3d = WorldLog(self._rerun, self._stream, self._world)

    @property
    def address(self) -> str:
        """Address of the viewer for a browser; empty where a file is written."""
        if not self.web_port:
            return ""
        return f"http://localhost:{self.web_port}/?url=rerun%2Bhttp://localhost:{self.grpc_port}/proxy"

    def add(self, step: Transition) -> bool:
        """Send a step; live, then wait for real time. Returns True: there is always more room."""
        rerun, stream = self._rerun, self._stream
        stream.set_time(TIME, duration=self._frames / self._env.control_hz)
        stream.set_time(FRAME, sequence=self._frames)
        self._frames += 1
        if step.step == 0:
            self._say(f"seed {step.seed}: {step.observation.instruction or self._task.instruction}")
        for camera, picture in step.observation.images.items():
            stream.log(schema.IMAGES + camera, rerun.Image(picture).compress(jpeg_quality=_JPEG_QUALITY))
        self._world.restore(step.state.physics, step.state.variation)
        for name, value in {
            schema.STATE: step.observation.state,
            schema.EXECUTED_ACTION: step.executed_action,
            schema.PROGRESS: step.progress,
            ERROR: self._task.error(self._world),
        }.items():
            stream.log(name, rerun.Scalars(value))
        self._add_label(step)
        self._in_3d.add(first=step.step == 0)
        if step.done:
            self._say(outcome(step))
        if self._clock is not None:
            self._clock.wait()
        return True

    def close(self) -> None:
        """Write or send what is still waiting."""
        self._stream.flush()
        self._stream.disconnect()

    def _add_label(self, step: Transition) -> None:
        if step.label is None:
            return
        self._stream.log(schema.ACTION, self._rerun.Scalars(step.label.action))
        phase = self._spec.phases[step.label.phase]
        if phase != self._phase or step.step == 0:
            self._stream.log(schema.EXPERT_PHASE, self._rerun.StateChange(state=phase))
            self._phase = phase

    def _say(self, text: str) -> None:
        self._stream.log(EVENTS, self._rerun.TextLog(text))

    def _serve(self) -> tuple[int, int]:
        """Serve the stream and the viewer; returns the ports of the viewer and the stream."""
        web, grpc = _free_port(_WEB_PORT), _free_port(_GRPC_PORT)
        uri = self._stream.serve_grpc(grpc_port=grpc, default_blueprint=self._blueprint())
        self._rerun.serve_web_viewer(web_port=web, open_browser=False, connect_to=uri)
        return web, grpc

    def _name_curves(self) -> None:
        for name in (schema.STATE, schema.ACTION, schema.EXECUTED_ACTION):
            self._stream.log(name, self._rerun.SeriesLines(names=self._spec.joint_names), static=True)

    def _blueprint(self) -> Any:
        import rerun.blueprint as layout

        x, y = self._world.scene.robot.workspace.centre
        eye = layout.EyeControls3D(position=(x + 1.1, y - 1.1, 0.9), look_target=(x, y, 0.15), eye_up=(0, 0, 1))
        pictures = [layout.Spatial2DView(origin=schema.IMAGES + name, name=name) for name in CAMERAS]
        no_legend = layout.PlotLegend(visible=False)
        curves = [
            layout.StateTimelineView(origin=schema.EXPERT_PHASE, name="phase"),
            layout.TimeSeriesView(contents=[schema.PROGRESS, ERROR], name="progress, error [m]"),
            layout.TimeSeriesView(origin=schema.STATE, name="joints and gripper", plot_legend=no_legend),
            layout.TimeSeriesView(origin=schema.EXECUTED_ACTION, name="executed action", plot_legend=no_legend),
            layout.TextLogView(origin=EVENTS, name="episodes"),
        ]
        return layout.Blueprint(
            layout.Horizontal(
                layout.Vertical(
                    layout.Spatial3DView(origin=ROOT, name="world", eye_controls=eye),
                    layout.Horizontal(*pictures),
                    row_shares=[3, 2],
                ),
                layout.Vertical(*curves, row_shares=[1, 2, 2, 2, 1]),
            ),
            layout.TimePanel(timeline=TIME, state="collapsed"),
            layout.SelectionPanel(state="hidden"),
            layout.BlueprintPanel(state="collapsed"),
        )


def _import_rerun() -> Any:
    try:
        import rerun
    except ImportError as error:
        raise ManipError(NO_RERUN) from error
    return rerun


def _free_port(wanted: int) -> int:
    """Return a port on which nobody listens: the wanted one, or any other."""
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(("", wanted))
        except OSError:
            one.bind(("", 0))
        return one.getsockname()[1]
