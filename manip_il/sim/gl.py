"""Chooses the OpenGL backend for off-screen pictures; must run before mujoco is imported."""

from __future__ import annotations

import ctypes.util
import os

_BACKENDS = {"egl": "EGL", "osmesa": "OSMesa"}  # in order of preference -> shared library
PACKAGES = "libegl1 libegl-mesa0 libgl1-mesa-dri libgl1"


def choose_backend() -> str | None:
    """Set MUJOCO_GL to `egl`, else `osmesa`, unless the user has set it; None where neither is there."""
    if "MUJOCO_GL" in os.environ:
        return os.environ["MUJOCO_GL"]
    for backend, library in _BACKENDS.items():
        if ctypes.util.find_library(library):
            os.environ["MUJOCO_GL"] = backend
            return backend
    return None
