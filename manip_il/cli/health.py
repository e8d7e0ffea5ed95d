"""`manip-il eval --check`: whether this machine or container can evaluate, in one line."""

from __future__ import annotations

import multiprocessing
import tempfile
from importlib import metadata

from manip_il.errors import ManipError, RenderError
from manip_il.tasks.envs import make_env

_FEWEST_COLOURS = 16  # in a picture of a scene; the emptiest ones hold hundreds


def healthy() -> str:
    """Return renderer, PyTorch and cores in one line. Raises `ManipError` for what an evaluation would miss here."""
    try:
        with tempfile.TemporaryFile() as file:
            file.write(b"x")
        multiprocessing.get_context("spawn").Lock()  # which lies in /dev/shm
    except OSError as error:
        raise ManipError(f"/tmp and /dev/shm must be writable, as by docker run --tmpfs /tmp: {error}") from error
    drawing = _draw()
    from manip_il.collect.workers import default_workers

    return f"{drawing}; torch {metadata.version('torch')}; cores {default_workers()}"


def _draw() -> str:
    """Draw the default scene; return vendor and renderer. Raises `RenderError` for a blank picture, too."""
    from manip_il.sim.config import CAMERAS, CameraConfig
    from manip_il.sim.render import pictures

    world, cameras = make_env(), CameraConfig(CAMERAS)
    world.start(0)
    drawn = pictures(world.scene, world.data, cameras)
    from OpenGL import GL  # mujoco has chosen its platform

    words = (GL.glGetString(name) for name in (GL.GL_VENDOR, GL.GL_RENDERER))
    renderer = " ".join(word.decode(errors="replace") if word else "unknown" for word in words)
    for camera, picture in drawn.items():
        colours = {tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()}
        if len(colours) < _FEWEST_COLOURS:  # as some drivers draw, without an error
            raise RenderError(f"camera {camera} sees nothing with {renderer}; try MUJOCO_GL=osmesa, or another driver")
    return renderer
