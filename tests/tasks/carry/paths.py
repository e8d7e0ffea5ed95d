"""The features of any path, by sums over short pieces of it."""

from __future__ import annotations

import numpy as np

from manip_il.tasks.carry.layout import Layout

PIECES = 20  # of every straight line


def path_features(layout: Layout, positions: np.ndarray) -> np.ndarray:
    """Return the features of a path of the object's centre, (T, 3) [m], as line integrals along it, (K,)."""
    ways = np.diff(positions, axis=0)
    points = positions[:-1, None] + (np.arange(PIECES) + 0.5)[:, None] / PIECES * ways[:, None]
    densities = layout.densities(points.reshape(-1, 3)).reshape(len(ways), PIECES, -1).mean(axis=1)
    return np.linalg.norm(ways, axis=1) @ densities
