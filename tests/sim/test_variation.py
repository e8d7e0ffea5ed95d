"""A variation is five numbers an object (half its lengths, its mass, its friction), and what the world draws."""

from __future__ import annotations

import copy

import mujoco
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.sim.shape import KINDS
from manip_il.sim.variation import (
    NOTHING_DRAWN,
    PER_OBJECT,
    Object,
    apply,
    with_drawn,
)
from manip_il.sim.world import World
from manip_il.tasks.envs import scene_of

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


def test_every_geom_of_an_object_touches_the_table_whatever_is_drawn():
    bar = """<mujoco><worldbody><geom type="box" size="1 1 0.02" pos="0 0 -0.02"/>
    <body name="bar" pos="0 0 0.041"><freejoint/><geom type="box" size="0.1 0.01 0.005" mass="0.1"/>
    <geom type="box" size="0.01 0.01 0.04" pos="0.1 0 0" mass="0.1"/>
    <geom type="box" size="0.01 0.01 0.04" pos="-0.1 0 0" mass="0.1"/></body></worldbody></mujoco>"""
    plain = mujoco.MjSpec.from_string(bar).compile()
    changed, like = copy.copy(plain), np.array([0.1, 0.01, 0.005, 0.3, 1.0, *NOTHING_DRAWN])
    apply(changed, plain, {"bar": Object("bar", 1, 1, 0, 0)}, NO_MOTORS, with_drawn(like, {"friction": 0.9}))
    data = mujoco.MjData(changed)
    mujoco.mj_step(changed, data, 500)
    assert data.qpos[2] == pytest.approx(0.04, abs=1e-3)
