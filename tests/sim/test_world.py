"""A world is one scene in one state, asked by name; its model is its own only where it was varied."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest

from manip_il.robots.spec import model_bytes
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import World
from manip_il.tasks.envs import scene_of
from manip_il.tasks.pick_place import OBJECT
from manip_il.tasks.starts import UPRIGHT

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
    world.data.qpos[world.scene.arm_q] = world.data.ctrl[world.scene.arm_ctrl] = world.scene.robot.home
    world.place(OBJECT, [*world.scene.robot.workspace.centre, 0.06] + BESIDE, np.array([0.9, 0.1, 0.3, 0.3]))
    mujoco.mj_step(world.model, world.data, steps)
    return world.physics().tobytes()


@every_scene
def test_a_world_as_compiled_shares_its_scenes_model(robot: str, task: str):
    scene = scene_of(robot, task)
    one, other = World(scene), World(scene)
    assert one.model is other.model is scene.model
    assert one.data is not other.data
    one.vary(scene.nominal.copy())
    assert one.model is scene.model


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
def test_the_arm_is_damped_and_driven_as_the_variation_says_and_the_gripper_as_ever(robot: str, task: str):
    world = World(scene_of(robot, task))
    world.vary(with_drawn(world.scene.nominal, {"joint_damping": 3.0, "actuator_gain": 0.64}))
    model, plain, arm = world.model, world.scene.model, world.scene.arm_ctrl
    dofs = [model.joint(f"robot/{name}").dofadr[0] for name in world.scene.robot.joints]
    np.testing.assert_allclose(model.dof_damping[dofs], 3.0 * plain.dof_damping[dofs])
    np.testing.assert_allclose(model.actuator_gainprm[arm, 0], 0.64 * plain.actuator_gainprm[arm, 0])
    np.testing.assert_allclose(model.actuator_biasprm[arm, 1:3], plain.actuator_biasprm[arm, 1:3] * [0.64, 0.8])
    for name, own in (("dof_damping", dofs), ("actuator_gainprm", arm), ("actuator_biasprm", arm)):
        others = np.delete(np.arange(len(getattr(plain, name))), own)
        np.testing.assert_array_equal(getattr(model, name)[others], getattr(plain, name)[others], err_msg=name)


def test_a_restored_world_is_the_one_that_was_saved(world: World):
    other = World(world.scene)
    world.vary(with_drawn(world.scene.nominal, HEAVY))
    fall(world, 30)
    world.update()
    other.restore(world.physics(), world.variation)
    assert other.physics().tobytes() == world.physics().tobytes()
    for name in (OBJECT, f"robot/{world.scene.robot.ee.body}"):
        np.testing.assert_array_equal(other.pose(name).position, world.pose(name).position)
        np.testing.assert_array_equal(other.pose(name).rotation, world.pose(name).rotation)


def test_answers_follow_the_world(world: World):
    gripper = world.scene.gripper
    for opening, x in ((0.02, 0.55), (0.075, 0.65)):
        world.data.qpos[gripper.q] = gripper.command(opening)
        world.place(OBJECT, np.array([x, 0.1, 0.2]), UPRIGHT)
        world.place("goal", np.array([x, 0.0, 0.3]), UPRIGHT)
        world.data.qpos[world.scene.arm_q] = np.asarray(world.scene.robot.home) + (x - 0.6)
        world.update()
        assert world.opening == pytest.approx(opening)
        assert world.pose(OBJECT).position[0] == world.goal[0] == pytest.approx(x)
        np.testing.assert_array_equal(world.ee.position, world.data.site("robot/ee").xpos)
