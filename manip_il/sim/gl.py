"""Chooses the OpenGL backend for off-screen pictures; must run before mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os

from manip_il.errors import RenderError

_BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}  # in order of preference -> shared library
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
_KNOWN = ("egl", "osmesa", "glfw", "glx", "cgl", "wgl", "")
_SWITCHES = ("enable", "enabled", "on", "true", "1", "disable", "disabled", "off", "false", "0")


def choose_backend() -> str | None:
    """Set MUJOCO_GL to `egl`, else `osmesa`, unless the user has set it; None where neither is there."""
    if "MUJOCO_GL" in os.environ:
        return os.environ["MUJOCO_GL"]
    for backend, library in _BACKENDS.items():
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return backend
    return None


def require_known_backend() -> None:
    """Raise `RenderError` where MUJOCO_GL is set to what mujoco does not know: it could not even be imported."""
    chosen = os.environ.get("MUJOCO_GL", "")
    if chosen.lower().strip() not in (*_KNOWN, *_SWITCHES):
        raise RenderError(f"MUJOCO_GL is {chosen!r}; expected egl or osmesa, or unset it")
