"""Named keypoints of a scene: the positions that its task observes, and the upper corners of its
boxes.
"""

from functools import lru_cache
from itertools import product

import mujoco
import numpy as np

from manip_il.mdp import F64
from manip_il.sim.scene import SCENES_KEPT
from manip_il.sim.world import Scene, World

_SIGNS = np.array(list(product((-1, 1), repeat=3)))  # signs of a box's corners
_NAMED = (mujoco.mjtObj.mjOBJ_BODY, mujoco.mjtObj.mjOBJ_GEOM, mujoco.mjtObj.mjOBJ_SITE)
_CORNERS = 4  # a box's upper corners, which cameras see


def points_in(world: World) -> dict[str, F64]:
    """Return the keypoints: name -> position (3,) [m].

    A vector that the task observes is a keypoint if it has the name of a body, geom or site. The
    upper corners of a box are numbered by their direction from its centre, seen from above.
    """
    model = world.scene.model
    found = {
        name: np.asarray(value)
        for name, value in world.scene.task.observe(world).items()
        if np.ndim(value) and any(mujoco.mj_name2id(model, kind, name) >= 0 for kind in _NAMED)
    }
    for name, one in world.scene.objects.items():
        if model.geom_type[one.geom] == mujoco.mjtGeom.mjGEOM_BOX:
            found |= {
                f"{name}.corner_{number}": at
                for number, at in enumerate(_upper_corners(world, name))
            }
    return found


@lru_cache(SCENES_KEPT)
def point_names(scene: Scene) -> tuple[str, ...]:
    """Return the names of `points_in`, in its order."""
    world = World(scene)
    world.update()
    return tuple(points_in(world))


def _upper_corners(world: World, name: str) -> F64:
    """The upper corners (4, 3) [m] of a box."""
    pose, half = world.pose(name), np.asarray(world.extents(name)) / 2
    around = (_SIGNS * half) @ pose.rotation.T
    upper = around[np.argsort(around[:, 2], kind="stable")[-_CORNERS:]]
    return pose.position + upper[np.argsort(np.arctan2(upper[:, 1], upper[:, 0]), kind="stable")]
