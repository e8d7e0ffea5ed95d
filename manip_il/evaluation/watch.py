"""Episodes as they happen: in a window, whose sliders may drive, or as Rerun shows them, live or from a file."""

from __future__ import annotations

import socket
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.collect.environments import env_spec
from manip_il.collect.rollout import Act, Turn
from manip_il.data import schema
from manip_il.errors import ManipError
from manip_il.mdp import Actor, Transition
from manip_il.sim.config import CAMERAS
from manip_il.sim.env import ManipEnv
from manip_il.sim.task import phases
from manip_il.sim.window import Clock, Window
from manip_il.sim.world import World
from manip_il.tasks.config import EnvConfig
from manip_il.tasks.envs import scene_of
from manip_il.tasks.table import get_task

F64 = NDArray[np.float64]
ERROR, EVENTS = "error", "events"  # Rerun's entities; the others have the names of a dataset's columns
TIME, FRAME = "time", "frame"  # timelines: [s] and control steps since the first episode began
_NO_RERUN = "rerun is not installed; run: pip install 'rerun-sdk>=0.33,<0.34'"
_JPEG_QUALITY = 90


class WindowScreen:
    """MuJoCo's viewer of one environment, with its phase and progress; objects can be pulled with the mouse.

    sliders: its control sliders drive. Raises `RenderError` where there is no display.
    """

    def __init__(self, env: ManipEnv, *, sliders: bool = False):
        self._env, self._phases = env, phases(env.scene.task)
        self._window = Window(env.scene, env.config.control_hz, sliders=sliders)
        self.act = slider_actions(self._window, env) if sliders else None

    def add(self, step: Transition) -> bool:
        """Show the world after a step, in real time; returns False once the window is closed."""
        phase = f"  {self._phases[step.label.phase]}" if step.label else ""
        solved = "  solved" if step.success else ""
        text = f"seed {step.seed}  step {step.step + 1}{phase}  progress {100 * self._env.progress:.0f} %{solved}"
        self._window.show(self._env.data, self._env.looks, text)
        self._window.pull(self._env.data)
        return self._window.is_open

    def close(self) -> None:
        """Close the window."""
        self._window.close()


def slider_actions(window: Window, env: ManipEnv) -> Act:
    """Return a driver that executes what the control sliders of a window say, joint targets and gripper command (n,).

    An episode begins with those that it starts from.
    """

    def act(turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        scene, before = env.scene, env.data.ctrl
        [turn] = turns
        commands = before if turn.step == 0 else window.commands
        opening = scene.gripper.commanded(commands[scene.gripper.ctrl], before[scene.gripper.ctrl])
        return [(scene.actions.join(commands[scene.arm_ctrl], opening), Actor.LEARNER)]

    return act


def outcome(step: Transition) -> str:
    """Return how the episode ended whose last step this is."""
    return f"seed {step.seed}: {'solved' if step.success or step.state.ever else 'not solved'}, {step.step + 1} steps"


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
        self._world = World(scene_of(env.robot, env.task, env.object, env.physics_step))
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

    def add(self, step: Transition) -> bool:
        """Send a step; live, then wait for real time. Returns True: there is always more room."""
        rerun, stream = self._rerun, self._stream
        stream.set_time(TIME, duration=self._frames / self._env.control_hz)
        stream.set_time(FRAME, sequence=self._frames)
        self._frames += 1
        if step.step == 0:
            self._phase = ""
            said = step.observation.instruction or self._task.instruction
            stream.log(EVENTS, rerun.TextLog(f"seed {step.seed}: {said}"))
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
        if step.done:
            stream.log(EVENTS, rerun.TextLog(outcome(step)))
        if self._clock is not None:
            self._clock.wait()
        return True

    def close(self) -> None:
        """Write or send what is still waiting."""
        self._stream.flush()
        self._stream.disconnect()


def _blueprint() -> Any:
    import rerun.blueprint as layout

    curves = [
        layout.StateTimelineView(origin=schema.EXPERT_PHASE, name="phase"),
        layout.TimeSeriesView(contents=[schema.PROGRESS, ERROR], name="progress, error [m]"),
        layout.TimeSeriesView(origin=schema.STATE, name="joints and gripper"),
        layout.TimeSeriesView(origin=schema.EXECUTED_ACTION, name="executed action"),
        layout.TextLogView(origin=EVENTS, name="episodes"),
    ]
    pictures = (layout.Spatial2DView(origin=schema.IMAGES + name, name=name) for name in CAMERAS)
    return layout.Blueprint(
        layout.Horizontal(layout.Vertical(*pictures), layout.Vertical(*curves, row_shares=[1, 2, 2, 2, 1])),
        layout.TimePanel(timeline=TIME, state="collapsed"),
        layout.SelectionPanel(state="hidden"),
        layout.BlueprintPanel(state="collapsed"),
    )


def _free_port(wanted: int) -> int:
    """A port on which nobody listens: the wanted one, or any other."""
    with socket.socket() as one:
        one.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            one.bind(("", wanted))
        except OSError:
            one.bind(("", 0))
        return one.getsockname()[1]
