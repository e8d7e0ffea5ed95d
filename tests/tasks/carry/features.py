"""Features of a carried object's path."""

import numpy as np

from manip_il.mdp import F64
from manip_il.tasks.carry.layout import Layout


def path_features(layout: Layout, positions: F64) -> F64:
    """Return the features of a path of the object's centre, (T, 3) [m], as line integrals along
    it, (K,).
    """
    pieces, steps = 20, np.diff(positions, axis=0)
    points = positions[:-1, None] + (np.arange(pieces) + 0.5)[:, None] / pieces * steps[:, None]
    densities = layout.densities(points.reshape(-1, 3)).reshape(len(steps), pieces, -1).mean(axis=1)
    return np.linalg.norm(steps, axis=1) @ densities
