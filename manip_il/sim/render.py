"""Off-screen pictures of a simulator state."""

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import RenderError, UnknownName
from manip_il.sim.gl import PACKAGES
from manip_il.sim.scene import CAMERAS, Scene


class Renderer:
    """One OpenGL context for one scene; use as a context manager, one alive at a time a process.

    Raises `RenderError`, naming Debian's packages, where neither EGL nor OSMesa works.
    """

    def __init__(self, scene: Scene, height: int = 240, width: int = 320):
        self.size = (height, width)
        try:
            self._renderer = mujoco.Renderer(scene.model, height=height, width=width)
        except Exception as error:  # mujoco raises many kinds, from ImportError to its own
            raise RenderError(
                f"no off-screen OpenGL ({type(error).__name__}: {error}); on Debian: apt-get install -y {PACKAGES}"
            ) from error

    def picture(self, data: mujoco.MjData, camera: str) -> NDArray[np.uint8]:
        """An RGB picture, uint8 (height, width, 3). Raises `UnknownName` for the camera."""
        if camera not in CAMERAS:
            raise UnknownName("camera", camera, CAMERAS)
        self._renderer.update_scene(data, camera=camera)
        return self._renderer.render()

    def close(self) -> None:
        """Free the OpenGL context."""
        self._renderer.close()

    def __enter__(self) -> Renderer:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()
