"""MuJoCo's own viewer of an environment, in real time, if there is a display.

It shows a copy of the model and of the physics: changes in its panels do not affect the episode,
except that callers can use the control sliders (`commands`) and the pull of the mouse (`pull`).
"""

import atexit
import contextlib
import os
import threading
import time
import warnings
from typing import Any

import mujoco
import numpy as np

from manip_il.errors import RenderError
from manip_il.mdp import F64
from manip_il.sim.config import FILM
from manip_il.sim.scene import STATE_KIND
from manip_il.sim.view import ViewModel
from manip_il.sim.world import Scene

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
        raise RenderError(
            f'no display: {named}; use render_mode="rgb_array", or manip-il view --output=FILE.rrd'
        )


class Clock:
    """Paces control steps in real time."""

    def __init__(self, hz: float):
        self._step, self._due = 1 / hz, 0.0

    def wait(self) -> None:
        """Wait until a control step has passed since the last call returned.

        Return at once if it already has.
        """
        now = time.monotonic()
        self._due = max(self._due + self._step, now)
        time.sleep(self._due - now)


class Window:
    """A window that shows a scene in real time."""

    def __init__(self, scene: Scene, control_hz: float, *, sliders: bool = False):
        """Open the window.

        Args:
            scene: The scene.
            control_hz: How often per second `show` is called.
            sliders: Whether to open the right panel, which has the control sliders.

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
            self._model, self._data, show_left_ui=False, show_right_ui=sliders
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

    @property
    def commands(self) -> F64:
        """Positions of the control sliders, in the actuators' units, (u,).

        They are as shown last, or as moved since.
        """
        return self._data.ctrl.copy()

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
