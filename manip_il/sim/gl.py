"""Choose the OpenGL backend for off-screen pictures; must run before mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os
from importlib import import_module
from typing import Any

PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"
REMEDY = f"unset MUJOCO_GL if it is set; on Debian: apt-get install -y {PACKAGES}"  # if no picture can be rendered


def choose_backend() -> None:
    """Set MUJOCO_GL to `egl` if that is installed, unless the user has set it."""
    if not os.environ.get("MUJOCO_GL") and ctypes.util.find_library("EGL"):
        os.environ["MUJOCO_GL"] = "egl"


def context_class() -> Any:
    """Return mujoco's class of off-screen contexts for the backend, even if mujoco was imported before us."""
    backend = os.environ.get("MUJOCO_GL", "").lower().strip()
    return import_module(f"mujoco.{backend if backend in ('egl', 'osmesa') else 'glfw'}").GLContext
