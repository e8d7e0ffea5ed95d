"""The drawer, where the cube lies in the way of its handle."""

import numpy as np
import pytest

from manip_il.tasks.drawer import CABINET, OBJECT
from manip_il.tasks.objects import UPRIGHT

from ..scenes import solve, started


@pytest.mark.parametrize(
    ("pulled", "rungs"),
    [
        (0.12, {"to_make_way", "make_way", "leave", "put_aside", "set_down"}),
        (0.0, {"put_aside", "set_down"}),
    ],
)
def test_a_cube_before_the_drawer_is_moved_out_of_its_way_first(pulled: float, rungs: set[str]):
    env = started("panda", "drawer")
    env.data.joint("drawer").qpos[0] = pulled
    at = env.world.pose(CABINET).position + [-0.09, 0.0, env.world.extents(OBJECT)[2] / 2]
    env.world.place(OBJECT, at, UPRIGHT)
    env.world.update()
    assert rungs <= set(solve(env))
    assert np.linalg.norm(env.world.pose(OBJECT).position - at) > 0.1
