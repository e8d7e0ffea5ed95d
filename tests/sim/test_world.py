"""A world is one scene in one state, asked by name.

Its model is its own only where it was varied.
"""

import mujoco
import numpy as np
import pytest

from manip_il.robots.spec import model_bytes
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import World
from manip_il.tasks.pick_place import OBJECT
from manip_il.worlds.ladder.world import scene_of

from ..scenes import world_at_home
from ..tables import WITH_A_CUBE, every_scene

BESIDE = np.array([-0.04, 0.1, 0.0])  # of the hand [m]
HEAVY = {"size": 0.07, "mass": 0.3, "friction": 0.7}


@pytest.fixture(params=WITH_A_CUBE, ids="-".join)
def world(request) -> World:
    return world_at_home(*request.param)


def fall(world: World, steps: int = 60) -> bytes:
    """The physics of a world in which the cube falls onto the table and the arm stays."""
    mujoco.mj_resetData(world.model, world.data)
    world.data.qpos[world.scene.arm_q] = world.data.ctrl[world.scene.arm_ctrl] = (
        world.scene.robot.home
    )
    world.place(
        OBJECT, [*world.scene.robot.workspace.centre, 0.06] + BESIDE, np.array([0.9, 0.1, 0.3, 0.3])
    )
    mujoco.mj_step(world.model, world.data, steps)
    return world.physics().tobytes()


def test_a_varied_world_has_a_model_of_its_own_and_leaves_the_shared_one(world: World):
    before, other = model_bytes(world.scene.model), World(world.scene)
    world.vary(with_drawn(world.scene.nominal, HEAVY))
    assert World(world.scene).model is world.scene.model
    other.vary(with_drawn(world.scene.nominal, {"size": 0.03}))
    assert world.extents(OBJECT)[0] == pytest.approx(0.07)
    assert other.extents(OBJECT)[0] == pytest.approx(0.03)
    fall(world)
    assert model_bytes(world.scene.model) == before


def test_a_variation_is_the_same_world_whatever_it_was_before(world: World):
    other, drawn = World(world.scene), with_drawn(world.scene.nominal, HEAVY)
    world.vary(with_drawn(world.scene.nominal, {"size": 0.03, "mass": 0.06, "friction": 1.4}))
    fall(world)
    world.vary(drawn)
    other.vary(drawn)
    assert fall(world) == fall(other)
    assert model_bytes(world.model) == model_bytes(other.model)


def test_the_drawn_friction_counts_whatever_the_cube_touches(world: World):
    world.vary(with_drawn(world.scene.nominal, {"friction": 0.4}))
    fall(world, 600)
    geom = world.scene.objects[OBJECT].geom
    touching = [contact for contact in world.data.contact if geom in contact.geom]
    assert touching
    assert all(contact.friction[0] == 0.4 for contact in touching)


@every_scene
def test_the_arm_is_damped_and_driven_as_the_variation_says_and_the_gripper_as_ever(
    robot: str, task: str
):
    world = World(scene_of(robot, task))
    world.vary(with_drawn(world.scene.nominal, {"joint_damping": 3.0, "actuator_gain": 0.64}))
    model, plain, arm = world.model, world.scene.model, world.scene.arm_ctrl
    dofs = [model.joint(f"robot/{name}").dofadr[0] for name in world.scene.robot.joints]
    np.testing.assert_allclose(model.dof_damping[dofs], 3.0 * plain.dof_damping[dofs])
    np.testing.assert_allclose(
        model.actuator_gainprm[arm, 0], 0.64 * plain.actuator_gainprm[arm, 0]
    )
    np.testing.assert_allclose(
        model.actuator_biasprm[arm, 1:3], plain.actuator_biasprm[arm, 1:3] * [0.64, 0.8]
    )
    np.testing.assert_array_equal(
        np.delete(model.dof_damping, dofs), np.delete(plain.dof_damping, dofs)
    )
