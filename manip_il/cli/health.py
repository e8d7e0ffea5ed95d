"""`manip-il eval --check`: whether this machine or container can evaluate, in one line."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import tempfile
import time
from importlib import metadata
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.errors import ManipError, RenderError
from manip_il.sim.gl import PACKAGES

if TYPE_CHECKING:
    from collections.abc import Mapping

    from manip_il.sim.render import Picture

_FRAMES = 20  # timed after the first one, which also loads the scene
_BACKENDS = ("egl", "osmesa", "glfw")  # the last one needs a display
_FEWEST_COLOURS = 16  # in a picture of a scene; the emptiest ones hold hundreds


def healthy() -> str:
    """Return renderer, PyTorch and cores in one line. Raises `ManipError` for what an evaluation would miss here.

    Draws a frame of the default scene, and checks the most frequent fault first.
    """
    check_backend(os.environ.get("MUJOCO_GL"))
    check_temporary_folder()
    check_shared_memory()
    drawing = _draw()
    from manip_il.collect.workers import default_workers

    return f"{drawing}; {describe_torch()}; cores {default_workers()}"


def check_backend(backend: str | None) -> None:
    """Raise `RenderError` for a MUJOCO_GL that mujoco cannot draw pictures off screen with."""
    if backend is None:
        install = f"on Debian: apt-get install -y {PACKAGES}"
        raise RenderError(f"MUJOCO_GL is not set, and neither EGL nor OSMesa is installed; {install}")
    if backend.lower() not in _BACKENDS:
        raise RenderError(f"MUJOCO_GL is {backend!r}; expected egl or osmesa, or unset it")


def check_temporary_folder() -> None:
    """Raise `ManipError` if no temporary file can be made."""
    try:
        with tempfile.TemporaryFile() as file:
            file.write(b"x")
    except OSError as error:
        raise ManipError(
            f"cannot create a temporary file ({error.strerror}); make /tmp writable (docker run --tmpfs /tmp), "
            "or set TMPDIR"
        ) from error
    home = Path(tempfile.gettempdir())
    if home == Path.cwd():  # Python's fallback, where none of the usual folders is writable
        raise ManipError(f"temporary files would go into {home}; make /tmp writable (docker run --tmpfs /tmp)")


def check_shared_memory() -> None:
    """Raise `ManipError` if processes cannot share a lock, which lies in /dev/shm."""
    try:
        multiprocessing.get_context("spawn").Lock()
    except (OSError, ImportError) as error:
        raise ManipError(f"processes cannot share a lock ({error}); make /dev/shm writable") from error


def check_pictures(pictures: Mapping[str, Picture]) -> None:
    """Raise `RenderError` for a blank picture, which some drivers draw without an error."""
    for camera, picture in pictures.items():
        colours = len({tuple(pixel) for pixel in picture.reshape(-1, 3).tolist()})
        if colours < _FEWEST_COLOURS:
            raise RenderError(
                f"camera {camera} sees {colours} colour{'s' if colours > 1 else ''}, expected a scene: OpenGL works "
                f"but draws nothing ({_renderer()}); try MUJOCO_GL=osmesa, or another driver"
            )


def _draw() -> str:
    """Draw and time the default scene; return renderer and speed."""
    from manip_il.sim.config import CAMERAS, CameraConfig
    from manip_il.sim.env import ManipEnv
    from manip_il.sim.render import pictures

    world, cameras = ManipEnv(), CameraConfig(CAMERAS)
    world.start(0)

    def draw() -> Mapping[str, Picture]:
        return pictures(world.config.robot, world.config.task, world.data, cameras, shape=world.config.object)

    check_pictures(draw())
    begin = time.perf_counter()
    for _ in range(_FRAMES):
        draw()
    each = (time.perf_counter() - begin) / (_FRAMES * len(CAMERAS))
    return f"{_renderer()}, {1e3 * each:.1f} ms a picture of {cameras.height} x {cameras.width}"


def _renderer() -> str:
    """Vendor and renderer of the current OpenGL context."""
    from OpenGL import GL

    words = (GL.glGetString(name) for name in (GL.GL_VENDOR, GL.GL_RENDERER))
    return " ".join(word.decode(errors="replace") if word else "unknown" for word in words)


def describe_torch() -> str:
    """Return Torch's version, and how many graphics cards CUDA's driver sees; `ManipError` if torch is missing.

    Torch itself is not imported: it would double the memory of a health check.
    """
    try:
        version = metadata.version("torch")
    except metadata.PackageNotFoundError as error:
        raise ManipError("torch is not installed; `make setup`, or build the image again") from error
    return f"torch {version}, graphics cards for CUDA {_cuda_devices()}"


def _cuda_devices() -> int:
    """How many graphics cards CUDA's driver sees; 0 without a driver."""
    count = ctypes.c_int(0)
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return 0
    return count.value if driver.cuInit(0) == 0 and driver.cuDeviceGetCount(ctypes.byref(count)) == 0 else 0
