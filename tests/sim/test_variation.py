"""A variation is five numbers an object (half its lengths, its mass, its friction), and what the world draws."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError, MismatchError
from manip_il.sim.conditions import Condition
from manip_il.sim.shape import KINDS
from manip_il.sim.variation import (
    NOTHING_DRAWN,
    OLDER,
    PER_OBJECT,
    Object,
    apply,
    completed,
    extents,
    nominal,
    part,
    same_physics,
    with_drawn,
)
from manip_il.sim.world import World
from manip_il.tasks.envs import scene_of
from manip_il.tasks.objects import CUBE_HALF, CUBE_MASS, FRICTION

from ..tables import every_scene_with_a_cube

lengths = st.floats(0.005, 0.1)
WHERE_IT_WAS_MADE = {"body_pos", "qpos0", "qpos_spring", "cam_poscom0", "light_poscom0"}  # which no start keeps
NO_MOTORS = np.array([], dtype=np.int64)
SHAPES = {
    "box": ("0.01 0.02 0.03", (0.02, 0.04, 0.06)),
    "sphere": ("0.02", (0.04, 0.04, 0.04)),
    "cylinder": ("0.02 0.03", (0.04, 0.04, 0.06)),
    "capsule": ("0.02 0.03", (0.04, 0.04, 0.10)),
}


def free_body(shape: str, size: str, mass: float = 0.2) -> tuple[mujoco.MjModel, dict[str, Object]]:
    xml = f"""<mujoco><worldbody><body name="thing"><freejoint name="thing"/>
    <geom type="{shape}" size="{size}" mass="{mass}"/></body></worldbody></mujoco>"""
    return mujoco.MjSpec.from_string(xml).compile(), {"thing": Object("thing", 1, 0, 0, 0)}


def inertia_tensor(model: mujoco.MjModel) -> np.ndarray:
    """Of the one body: MuJoCo turns its axes so that its moments are sorted."""
    axes = np.empty(9)
    mujoco.mju_quat2Mat(axes, model.body_iquat[1])
    axes = axes.reshape(3, 3)
    return axes @ np.diag(model.body_inertia[1]) @ axes.T


@every_scene_with_a_cube
def test_a_scenes_nominal_variation_is_its_models(robot: str, task: str):
    objects = [CUBE_HALF] * 3 + [CUBE_MASS, FRICTION]
    np.testing.assert_array_equal(scene_of(robot, task).nominal, [*objects, *NOTHING_DRAWN])


CUBE, TALL = [0.025, 0.025, 0.025, 0.1, 1.0], [0.01, 0.02, 0.04, 0.1, 1.0]


@pytest.mark.parametrize(
    ("before", "drawn", "after"),
    [
        (CUBE, {"size": 0.07}, [0.035, 0.035, 0.035, 0.1, 1.0]),
        (TALL, {"size": 0.04}, [0.005, 0.01, 0.02, 0.1, 1.0]),  # the longest edge; proportions stay
        (CUBE, {"mass": 0.3}, [0.025, 0.025, 0.025, 0.3, 1.0]),
        (CUBE, {"friction": 0.5}, [0.025, 0.025, 0.025, 0.1, 0.5]),
        (CUBE, {"colour": [1, 0, 0]}, CUBE),
        (CUBE + TALL, {"mass": 0.2}, [0.025, 0.025, 0.025, 0.2, 1.0, 0.01, 0.02, 0.04, 0.2, 1.0]),
        ([], {"mass": 0.2, "size": 0.05}, []),
    ],
)
def test_what_is_drawn_stands_at_its_place_and_the_rest_as_it_was(before: list[float], drawn, after: list[float]):
    base = np.array([*before, *NOTHING_DRAWN])
    np.testing.assert_allclose(with_drawn(base, drawn)[: len(after)], after)
    assert base.tolist() == [*before, *NOTHING_DRAWN]


EVERYTHING = Condition(
    "everything",
    **dict.fromkeys(("joint_damping", "actuator_gain", "brightness"), (0.5, 2.0)),
    **dict.fromkeys(("size", "posture", "camera_shift", "camera_turn", "light_turn"), (0.03, 0.07)),
    colour=(0, 1),
    table=(0, 1),
)


@every_scene_with_a_cube
def test_what_is_drawn_of_the_world_can_be_read_off_its_variation(robot: str, task: str):
    drawn = EVERYTHING.draw(3).values
    varied = with_drawn(scene_of(robot, task).nominal, drawn)
    assert 2 * varied[:3].max() == pytest.approx(drawn["size"])
    for name in ("joint_damping", "actuator_gain", "posture", "colour", "table", "brightness", "light_turn"):
        np.testing.assert_array_equal(part(varied, name), np.ravel(drawn[name]), err_msg=name)
    for name in ("camera_shift", "camera_turn"):
        for camera, moved in drawn[name].items():
            np.testing.assert_array_equal(part(varied, f"{name}.{camera}"), moved)


@pytest.mark.parametrize("task", ["pick_place", "lift"])
@pytest.mark.parametrize("kind", KINDS)
def test_a_world_of_any_shape_has_the_one_that_is_drawn_as_mujoco_would_compile_it(task: str, kind: str):
    world, own = World(scene_of("panda", task, "any")), scene_of("panda", task, f"{kind}:0.043")
    for other, width in (("sphere", 0.02), ("box", 0.07), (kind, 0.043)):
        world.vary(with_drawn(world.scene.nominal, {"shape": other, "size": width}))
    np.testing.assert_allclose(world.variation[:PER_OBJECT], own.nominal[:PER_OBJECT], rtol=1e-12)
    arrays = {name for name in dir(own.model) if isinstance(getattr(own.model, name), np.ndarray)}
    for name in arrays - WHERE_IT_WAS_MADE:
        ours, compiled = getattr(world.model, name), getattr(own.model, name)
        np.testing.assert_allclose(ours, compiled, rtol=1e-9, atol=1e-15, err_msg=name)


def test_a_variation_of_objects_alone_is_one_in_which_nothing_else_is_drawn():
    base = np.array([*CUBE, *NOTHING_DRAWN])
    np.testing.assert_array_equal(completed(np.array(CUBE), base), base)
    assert completed(base, base) is base
    with pytest.raises(MismatchError, match="size of the variation"):
        completed(base[:-1], base)


def test_how_the_world_looks_and_began_is_no_physics():
    base = np.array([*CUBE, *NOTHING_DRAWN])
    assert same_physics(
        base, with_drawn(base, {"colour": [1, 0, 0], "table": [0, 1, 0], "posture": 0.1, "brightness": 0.5})
    )
    for name in ("size", "mass", "friction", "joint_damping", "actuator_gain"):
        assert not same_physics(base, with_drawn(base, {name: 0.7})), name


@pytest.mark.parametrize("shape", SHAPES)
def test_extents_are_the_lengths_along_a_things_own_axes(shape: str):
    size, expected = SHAPES[shape]
    model, _ = free_body(shape, size)
    np.testing.assert_allclose(extents(int(model.geom_type[0]), model.geom_size[0]), expected)
    np.testing.assert_allclose(2 * model.geom_aabb[0, 3:], expected)


def test_a_shape_that_nobody_grasps_is_refused():
    with pytest.raises(ManipError, match="expected a box, cylinder, sphere, capsule or mesh"):
        extents(int(mujoco.mjtGeom.mjGEOM_ELLIPSOID), np.ones(3))


@pytest.mark.parametrize("shape", SHAPES)
@given(x=lengths, y=lengths, z=lengths, mass=st.floats(0.01, 2))
def test_a_changed_thing_is_as_mujoco_would_compile_it(shape: str, x: float, y: float, z: float, mass: float):
    size = {"box": (x, y, z), "sphere": (x,), "cylinder": (x, y), "capsule": (x, y)}[shape]
    plain, objects = free_body(shape, SHAPES[shape][0])
    compiled, _ = free_body(shape, " ".join(map(repr, size)), mass)
    changed = copy.copy(plain)
    apply(changed, plain, objects, NO_MOTORS, np.array([*size, *[0.0] * (3 - len(size)), mass, 1.0, *NOTHING_DRAWN]))
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    np.testing.assert_allclose(inertia_tensor(changed), inertia_tensor(compiled), rtol=1e-6, atol=1e-12)
    for name in ("body_mass", "body_subtreemass", "geom_rbound", "geom_aabb"):
        np.testing.assert_allclose(getattr(changed, name), getattr(compiled, name), rtol=1e-9, err_msg=name)


def test_a_nominal_variation_changes_nothing():
    plain, objects = free_body("box", "0.02 0.02 0.02")
    changed = copy.copy(plain)
    apply(changed, plain, objects, NO_MOTORS, nominal(plain, objects))
    mujoco.mj_setConst(changed, mujoco.MjData(changed))
    for name in ("body_mass", "body_inertia", "geom_size", "geom_friction", "geom_priority", "geom_aabb", "bvh_aabb"):
        np.testing.assert_array_equal(getattr(changed, name), getattr(plain, name), err_msg=name)


def test_only_a_drawn_friction_has_priority():
    plain, objects = free_body("box", "0.02 0.02 0.02")
    for friction, priority in ((0.5, 1), (float(plain.geom_friction[0, 0]), 0)):
        changed = copy.copy(plain)
        apply(changed, plain, objects, NO_MOTORS, with_drawn(nominal(plain, objects), {"friction": friction}))
        assert changed.geom_priority[0] == priority


@pytest.mark.parametrize("lacks", OLDER)
def test_an_older_state_lacks_numbers_at_the_end_of_which_nothing_was_drawn(lacks: int):
    like = np.array([*CUBE, *NOTHING_DRAWN])
    older = with_drawn(like, {"size": 0.04})[:-lacks]
    whole = completed(older, like)
    np.testing.assert_array_equal(whole[:-lacks], older)
    np.testing.assert_array_equal(whole[-lacks:], NOTHING_DRAWN[-lacks:])
    with pytest.raises(MismatchError, match="size of the variation"):
        completed(older[:-1], like)
