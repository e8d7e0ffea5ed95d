"""A variation is five numbers an object (half its lengths, its mass, its friction), and what the
world draws.
"""

import copy

import mujoco
import numpy as np
import pytest

from manip_il.sim.shape import KINDS
from manip_il.sim.variation import (
    NOTHING_DRAWN,
    PER_OBJECT,
    Object,
    apply,
    with_drawn,
)
from manip_il.sim.world import World
from manip_il.worlds.ladder.world import scene_of

# which no start keeps
WHERE_IT_WAS_MADE = {"body_pos", "qpos0", "qpos_spring", "cam_poscom0", "light_poscom0"}
NO_MOTORS = np.array([], dtype=np.int64)


@pytest.mark.parametrize("task", ["pick_place", "lift"])
@pytest.mark.parametrize(
    ("given", "drawn", "same_as"),
    [
        *(("any", {"shape": kind, "size": 0.043}, f"{kind}:0.043") for kind in KINDS),
        ("box:0.06x0.03x0.04", {"size": 0.09}, "box:0.09x0.045x0.06"),
        ("cylinder:0.04x0.08", {"size": 0.06}, "cylinder:0.03x0.06"),
        ("capsule:0.03x0.05", {"size": 0.06}, "capsule:0.06x0.1"),
    ],
)
def test_a_drawn_object_is_as_mujoco_would_compile_it(task: str, given: str, drawn, same_as: str):
    world, own = World(scene_of("panda", task, given)), scene_of("panda", task, same_as)
    for other in ({"size": 0.02}, {"size": 0.07, "mass": 0.3}, drawn | {"mass": own.nominal[3]}):
        world.vary(with_drawn(world.scene.nominal, other))
    np.testing.assert_allclose(world.variation[:PER_OBJECT], own.nominal[:PER_OBJECT], rtol=1e-12)
    arrays = {name for name in dir(own.model) if isinstance(getattr(own.model, name), np.ndarray)}
    for name in arrays - WHERE_IT_WAS_MADE:
        ours, compiled = getattr(world.model, name), getattr(own.model, name)
        np.testing.assert_allclose(ours, compiled, rtol=1e-9, atol=1e-15, err_msg=name)


def test_every_geom_of_an_object_touches_the_table_whatever_is_drawn():
    bar = """<mujoco><worldbody><geom type="box" size="1 1 0.02" pos="0 0 -0.02"/>
    <body name="bar" pos="0 0 0.041"><freejoint/><geom type="box" size="0.1 0.01 0.005" mass="0.1"/>
    <geom type="box" size="0.01 0.01 0.04" pos="0.1 0 0" mass="0.1"/>
    <geom type="box" size="0.01 0.01 0.04" pos="-0.1 0 0" mass="0.1"/></body></worldbody></mujoco>"""
    plain = mujoco.MjSpec.from_string(bar).compile()
    changed, like = copy.copy(plain), np.array([0.1, 0.01, 0.005, 0.3, 1.0, *NOTHING_DRAWN])
    apply(
        changed,
        plain,
        {"bar": Object("bar", 1, 1, 0, 0)},
        NO_MOTORS,
        with_drawn(like, {"friction": 0.9}),
    )
    data = mujoco.MjData(changed)
    mujoco.mj_step(changed, data, 500)
    assert data.qpos[2] == pytest.approx(0.04, abs=1e-3)
