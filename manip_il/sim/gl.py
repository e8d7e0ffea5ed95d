"""Chooses the OpenGL backend for off-screen pictures; must run before mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os
from importlib import import_module
from typing import Any

from manip_il.errors import RenderError

_BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}  # in order of preference -> shared library
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
_DISPLAY = ("glfw", "glx", "", "enable", "enabled", "on", "true", "1")  # for all of these mujoco takes glfw
_OFF = ("disable", "disabled", "off", "false", "0")


def choose_backend() -> str | None:
    """Set MUJOCO_GL to `egl`, else `osmesa`, unless the user has set it; None if neither is there."""
    if os.environ.get("MUJOCO_GL"):
        return os.environ["MUJOCO_GL"]
    backend = _installed()
    if backend is not None:
        os.environ["MUJOCO_GL"] = backend
    return backend


def require_known_backend() -> None:
    """Raise `RenderError` if mujoco could not even be imported with what MUJOCO_GL is set to."""
    backend = _backend()
    if backend not in (*_BACKENDS, *_DISPLAY, *_OFF):
        raise RenderError(f"MUJOCO_GL is {os.environ['MUJOCO_GL']!r}; expected egl or osmesa, or unset it")
    if backend == "osmesa" and ctypes.util.find_library(_BACKENDS[backend]) is None:
        raise RenderError("MUJOCO_GL is 'osmesa', whose library is not installed; unset it")


def context_class() -> Any:
    """Return mujoco's class of off-screen contexts of the backend, whether or not mujoco was imported before us.

    Raises `RenderError` if MUJOCO_GL switches it off, and whatever the backend's libraries raise.
    """
    backend = _backend()
    if backend in _OFF:
        raise RenderError("pictures are switched off")
    return import_module(f"mujoco.{backend if backend in _BACKENDS else 'glfw'}").GLContext


def remedy() -> str:
    """Return what to do if no picture can be drawn: leave the choice to this program, else install OpenGL."""
    if _backend() and _installed() not in (None, _backend()):
        return f"unset MUJOCO_GL={os.environ['MUJOCO_GL']}"
    return f"on Debian: apt-get install -y {PACKAGES}"


def _backend() -> str:
    return os.environ.get("MUJOCO_GL", "").lower().strip()


def _installed() -> str | None:
    return next((name for name, library in _BACKENDS.items() if ctypes.util.find_library(library)), None)
