"""Chooses the OpenGL backend for off-screen pictures; must run before mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os
from importlib import import_module
from typing import Any

from manip_il.errors import RenderError

PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
_OWN = ("egl", "osmesa")  # for what a display gives, mujoco takes glfw, by these names:
_DISPLAY = ("glfw", "glx", "", "enable", "enabled", "on", "true", "1")
_OFF = ("disable", "disabled", "off", "false", "0")


def choose_backend() -> None:
    """Set MUJOCO_GL to `egl` where that is installed, unless the user has set it."""
    if not os.environ.get("MUJOCO_GL") and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"


def require_known_backend() -> None:
    """Raise `RenderError` if mujoco does not know what MUJOCO_GL is set to, and cannot even be imported."""
    if _backend() not in (*_OWN, *_DISPLAY, *_OFF):
        raise RenderError(f"MUJOCO_GL is {os.environ['MUJOCO_GL']!r}; expected egl or osmesa, or unset it")


def context_class() -> Any:
    """Return mujoco's class of off-screen contexts of the backend, whether or not mujoco was imported before us.

    Raises `RenderError` if MUJOCO_GL switches it off, and whatever the backend's libraries raise.
    """
    if _backend() in _OFF:
        raise RenderError("pictures are switched off")
    return import_module(f"mujoco.{_backend() if _backend() in _OWN else 'glfw'}").GLContext


def remedy() -> str:
    """Return what to do if no picture can be drawn: leave the choice to this program, else install OpenGL."""
    if _backend() not in ("", "egl") and ctypes.util.find_library("EGL"):
        return f"unset MUJOCO_GL={os.environ['MUJOCO_GL']}"
    return f"on Debian: apt-get install -y {PACKAGES}"


def _backend() -> str:
    return os.environ.get("MUJOCO_GL", "").lower().strip()
