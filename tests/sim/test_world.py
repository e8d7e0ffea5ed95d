"""A world is one scene in one state, asked by name; its model is its own only where it was varied."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from manip_il.errors import ManipError, MismatchError, UnknownName
from manip_il.sim.variation import WORLD_SIZE, with_drawn
from manip_il.sim.world import World
from manip_il.tasks.envs import scene_of
from manip_il.tasks.pick_place import OBJECT
from manip_il.tasks.starts import UPRIGHT

from ..scenes import world_at_home
from ..tables import WITH_A_CUBE, every_scene, every_scene_with_a_cube

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
    before, other = world.scene.model_bytes(), World(world.scene)
    world.vary(with_drawn(world.scene.nominal, HEAVY))
    assert World(world.scene).model is world.scene.model
    other.vary(with_drawn(world.scene.nominal, {"size": 0.03}))
    assert world.extents(OBJECT)[0] == pytest.approx(0.07)
    assert other.extents(OBJECT)[0] == pytest.approx(0.03)
    fall(world)
    assert world.scene.model_bytes() == before


@every_scene_with_a_cube
def test_back_to_nominal_is_never_having_varied(robot: str, task: str):
    scene = scene_of(robot, task)
    plain, varied = World(scene), World(scene)
    varied.vary(with_drawn(scene.nominal, HEAVY))
    fall(varied)
    varied.vary(scene.nominal)
    assert varied.model is scene.model
    assert fall(varied) == fall(plain)


def test_a_variation_is_the_same_world_whatever_it_was_before(world: World):
    other, drawn = World(world.scene), with_drawn(world.scene.nominal, HEAVY)
    world.vary(with_drawn(world.scene.nominal, {"size": 0.03, "mass": 0.06, "friction": 1.4}))
    fall(world)
    world.vary(drawn)
    other.vary(drawn)
    assert fall(world) == fall(other)
    assert model_bytes(world) == model_bytes(other)


def model_bytes(world: World) -> bytes:
    buffer = np.zeros(mujoco.mj_sizeModel(world.model), dtype=np.uint8)
    mujoco.mj_saveModel(world.model, None, buffer)
    return buffer.tobytes()


@given(st.floats(0.03, 0.07), st.floats(0.05, 0.3), st.floats(0.3, 2))
@settings(max_examples=25)
def test_physics_has_what_the_variation_says(edge: float, mass: float, friction: float):
    world = World(scene_of("fetch", "pick_place"))
    world.vary(with_drawn(world.scene.nominal, {"size": edge, "mass": mass, "friction": friction}))
    one, model = world.scene.objects[OBJECT], world.model
    np.testing.assert_allclose(model.geom_size[one.geom], edge / 2)
    assert model.body_mass[one.body] == mass
    np.testing.assert_allclose(model.body_inertia[one.body], mass * edge**2 / 6)
    assert model.geom_friction[one.geom, 0] == friction
    assert world.extents(OBJECT) == pytest.approx((edge, edge, edge))
    # What MuJoCo works out from them.
    assert model.body_subtreemass[one.body] == pytest.approx(mass)
    np.testing.assert_allclose(model.dof_invweight0[one.v : one.v + 3], 1 / mass)
    np.testing.assert_allclose(model.dof_invweight0[one.v + 3 : one.v + 6], 6 / (mass * edge**2))
    assert model.geom_rbound[one.geom] == pytest.approx(np.sqrt(3) * edge / 2)


def test_the_drawn_friction_counts_whatever_the_cube_touches(world: World):
    world.vary(with_drawn(world.scene.nominal, {"friction": 0.4}))
    fall(world, 600)
    geom = world.scene.objects[OBJECT].geom
    touching = [contact for contact in world.data.contact if geom in contact.geom]
    assert touching
    assert all(contact.friction[0] == 0.4 for contact in touching)


@pytest.mark.parametrize("edge", [0.03, 0.07])
def test_a_cube_of_another_size_rests_on_the_table_and_not_in_it(world: World, edge: float):
    world.vary(with_drawn(world.scene.nominal, {"size": edge}))
    world.place(OBJECT, [*world.scene.robot.workspace.centre, edge / 2 + 0.01] + BESIDE, UPRIGHT)
    mujoco.mj_step(world.model, world.data, 400)
    world.update()
    assert world.pose(OBJECT).position[2] == pytest.approx(edge / 2, abs=5e-4)


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


def test_a_softer_arm_lags_farther_behind_its_command(world: World):
    behind = []
    for gain in (1.3, 1.0, 0.7):
        world.vary(with_drawn(world.scene.nominal, {"actuator_gain": gain}))
        mujoco.mj_resetData(world.model, world.data)
        world.data.qpos[world.scene.arm_q] = world.scene.robot.home
        world.data.ctrl[world.scene.arm_ctrl] = np.asarray(world.scene.robot.home) + 0.1
        mujoco.mj_step(world.model, world.data, 25)
        behind.append(np.abs(world.data.ctrl[world.scene.arm_ctrl] - world.data.qpos[world.scene.arm_q]).max())
    assert behind == sorted(behind)
    assert behind[2] > 1.1 * behind[0]


def test_a_world_keeps_no_hold_of_the_numbers_that_it_was_varied_by(world: World):
    drawn = with_drawn(world.scene.nominal, HEAVY)
    world.vary(drawn)
    drawn[:] = 1.0
    assert world.variation[0] == pytest.approx(0.035)


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


def test_numbers_of_another_scene_are_refused_with_both_sizes(world: World):
    with pytest.raises(MismatchError, match=rf"has 3, {world.scene.name} has {world.scene.state_size}"):
        world.restore(np.zeros(3), world.scene.nominal)
    with pytest.raises(MismatchError, match=rf"size of the variation.*has 3, .*has {5 + WORLD_SIZE}"):
        world.vary(np.ones(3))
    with pytest.raises(MismatchError, match=rf"has 5, .*has {WORLD_SIZE}"):
        World(scene_of("fetch", "reach")).vary(np.ones(5))


def test_what_was_worked_out_is_known_until_the_world_moves(world: World):
    answers = itertools.count()

    def known() -> int:
        return world.remember("answer", lambda: next(answers))

    assert [known(), known(), known()] == [0, 0, 0]
    world.update()
    assert known() == 1
    world.vary(with_drawn(world.scene.nominal, HEAVY))
    world.update()
    assert known() == 2
    world.restore(world.physics(), world.variation)
    assert known() == 3


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


def test_placing_puts_an_object_at_rest(world: World):
    world.data.qvel[:] = 1.0
    world.place(OBJECT, np.array([0.5, 0.1, 0.3]), UPRIGHT)
    world.update()
    np.testing.assert_array_equal(world.pose(OBJECT).position, [0.5, 0.1, 0.3])
    np.testing.assert_allclose(world.pose(OBJECT).rotation, np.eye(3))
    assert not world.data.joint(OBJECT).qvel.any()
    assert world.data.qvel.any()


def test_what_cannot_be_placed_is_refused_by_name(world: World):
    with pytest.raises(UnknownName, match=r"unknown body 'objct'.*did you mean 'object'"):
        world.place("objct", np.zeros(3), UPRIGHT)
    with pytest.raises(UnknownName, match="did you mean 'goal'"):
        world.pose("gaol")
    hand = f"robot/{world.scene.robot.ee.body}"
    with pytest.raises(ManipError, match=f"'{hand}' is neither an object nor a mocap body"):
        world.place(hand, np.zeros(3), UPRIGHT)
