"""Objects that tasks share: cubes, and the marker of a goal."""

from __future__ import annotations

import mujoco

from manip_il.sim.world import GOAL

CUBE_HALF = 0.025  # [m]
CUBE_MASS = 0.1  # [kg]
FRICTION = 1.0  # sliding, against anything
RED = (0.86, 0.24, 0.16)
_GREEN = (0.12, 0.72, 0.35, 0.55)


def add_cube(
    spec: mujoco.MjSpec, name: str, half: float = CUBE_HALF, mass: float = CUBE_MASS, colour: tuple[float, ...] = RED
) -> None:
    """Add a cube that lies free: half its edge [m], its mass [kg], its red, green and blue."""
    material = spec.add_material(name=name, rgba=[*colour, 1], specular=0.3, shininess=0.5)
    body = spec.worldbody.add_body(name=name, pos=[0.5, 0, half])
    body.add_freejoint(name=name)
    body.add_geom(
        name=name,
        type=mujoco.mjtGeom.mjGEOM_BOX,
        size=[half] * 3,
        mass=mass,
        material=material.name,
        condim=4,
        friction=[FRICTION, 0.02, 0.0001],
        solimp=[0.95, 0.99, 0.001, 0.5, 2],
        solref=[0.01, 1],
    )


def add_goal(spec: mujoco.MjSpec) -> None:
    """Add a marker without contacts; a mocap body, so that lockstep environments can share one model."""
    material = spec.add_material(name=GOAL, rgba=list(_GREEN), specular=0.0, emission=0.4)
    body = spec.worldbody.add_body(name=GOAL, mocap=True, pos=[0.5, 0, 0.2])
    sphere = mujoco.mjtGeom.mjGEOM_SPHERE
    body.add_geom(name=GOAL, type=sphere, size=[0.02, 0, 0], material=material.name, contype=0, conaffinity=0, mass=0)
