"""Makes a model that pictures are drawn from look as one episode has it, and plain again for the next."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np

from manip_il.sim.look import PLAIN, Appearance
from manip_il.sim.scene import camera_id

_CHANGED = (
    "geom_size",
    "geom_matid",
    "geom_rgba",
    "cam_pos",
    "cam_quat",
    "light_pos",
    "light_dir",
    "light_ambient",
    "light_diffuse",
    "light_specular",
)
_LAMPS = ("light_ambient", "light_diffuse", "light_specular")


class Wardrobe:
    """The plain looks of a model that is drawn from, and how to leave them and come back. objects: their geoms."""

    def __init__(self, model: mujoco.MjModel, objects: Sequence[int] = ()):
        self._model: Any = model
        self._objects = objects
        self._plain = {name: getattr(self._model, name).copy() for name in _CHANGED}
        lamp = self._model.vis.headlight
        self._headlight = tuple(np.array(colour) for colour in (lamp.ambient, lamp.diffuse, lamp.specular))
        self._worn = PLAIN

    def wear(self, appearance: Appearance) -> None:
        """Look like this from the next picture on. OpenGL is told nothing: none of it lies on the graphics card."""
        if appearance == self._worn:
            return
        for name, plain in self._plain.items():
            getattr(self._model, name)[:] = plain
        self._cube(appearance)
        self._cameras(appearance)
        light_up(self._model, appearance.brightness, appearance.light_turn, self._headlight)
        self._worn = appearance

    def _cube(self, appearance: Appearance) -> None:
        if appearance.edge is None and appearance.colour is None:
            return
        for geom in self._objects:
            if appearance.edge is not None:
                self._model.geom_size[geom] *= appearance.edge / 2 / self._model.geom_size[geom].max()
            if appearance.colour is not None:
                self._model.geom_matid[geom] = -1  # a material's colour would hide the geom's
                self._model.geom_rgba[geom] = [*appearance.colour, 1.0]

    def _cameras(self, appearance: Appearance) -> None:
        shifts, turns = dict(appearance.camera_shift), dict(appearance.camera_turn)
        for name in {*shifts, *turns}:
            camera = camera_id(self._model, name)
            quat, turn, moved = self._model.cam_quat[camera].copy(), np.empty(4), np.empty(3)
            mujoco.mju_rotVecQuat(moved, np.asarray(shifts.get(name, (0.0, 0.0, 0.0))), quat)
            self._model.cam_pos[camera] += moved
            vector = np.deg2rad(turns.get(name, (0.0, 0.0, 0.0)))
            angle = float(np.linalg.norm(vector))
            mujoco.mju_axisAngle2Quat(turn, vector / angle if angle else np.array([1.0, 0, 0]), angle)
            mujoco.mju_mulQuat(self._model.cam_quat[camera], quat, turn)


def light_up(model: Any, brightness: float, light_turn: float, headlight: Any = None) -> None:
    """Multiply every lamp by a factor, and turn those that stand in the world about the vertical [deg].

    headlight: its three colours before, where `model` may have others by now.
    """
    lamp = model.vis.headlight
    before = headlight or tuple(np.array(colour) for colour in (lamp.ambient, lamp.diffuse, lamp.specular))
    for colour, plain in zip((lamp.ambient, lamp.diffuse, lamp.specular), before, strict=True):
        colour[:] = plain * brightness
    for name in _LAMPS:
        getattr(model, name)[:] *= brightness
    turn = np.deg2rad(light_turn)
    rotation = np.array([[np.cos(turn), -np.sin(turn), 0], [np.sin(turn), np.cos(turn), 0], [0, 0, 1]])
    in_world = model.light_bodyid == 0
    for vectors in (model.light_pos, model.light_dir):
        vectors[in_world] = vectors[in_world] @ rotation.T
