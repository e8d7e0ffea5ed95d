"""Nine objects as meshes, made of numbers: each function returns a closed `Trimesh` in metres, z
up.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import trimesh
from trimesh.creation import box, cone, revolve, torus


def prism(
    outline: Sequence[tuple[float, float]], height: float, middle: tuple[float, float] = (0, 0)
) -> trimesh.Trimesh:
    """An outline, all of which is seen from `middle`, drawn up along z."""
    n = len(outline)
    points = np.array([(*point, z) for z in (0.0, height) for point in (*outline, middle)])
    sides = [(i, (i + 1) % n) for i in range(n)]
    top = n + 1
    faces = [(j, i, n) for i, j in sides] + [(i + top, j + top, n + top) for i, j in sides]
    faces += [face for i, j in sides for face in ((i, j, i + top), (j, j + top, i + top))]
    return trimesh.Trimesh(points, faces)


def mug() -> trimesh.Trimesh:
    cup = revolve(
        [(0, 0), (0.027, 0), (0.027, 0.065), (0.024, 0.065), (0.024, 0.004), (0, 0.004)],
        sections=32,
    )
    handle = box((0.018, 0.008, 0.04)).apply_translation((0.035, 0, 0.033))
    return trimesh.util.concatenate([cup, handle])


def bottle() -> trimesh.Trimesh:
    outline = [(0, 0), (0.022, 0), (0.022, 0.065), (0.011, 0.085), (0.011, 0.105), (0, 0.105)]
    return revolve(outline, sections=32)


def angle() -> trimesh.Trimesh:
    return prism(
        [(0, 0), (0.07, 0), (0.07, 0.025), (0.025, 0.025), (0.025, 0.06), (0, 0.06)],
        0.025,
        (0.012, 0.012),
    )


def wedge() -> trimesh.Trimesh:
    lying = prism([(0, 0), (0.07, 0), (0.07, 0.035)], 0.035, (0.05, 0.01))
    return lying.apply_transform(trimesh.transformations.rotation_matrix(np.pi / 2, (1, 0, 0)))


def star() -> trimesh.Trimesh:
    turns = np.arange(10) * np.pi / 5
    return prism(
        [(r * np.cos(t), r * np.sin(t)) for t, r in zip(turns, (0.03, 0.014) * 5, strict=True)],
        0.035,
    )


def bowl() -> trimesh.Trimesh:
    turn = np.linspace(0, np.pi / 2, 10)
    outer = [(0.032 * np.cos(t), 0.032 * np.sin(t)) for t in turn]
    inner = [(0.028 * np.cos(t), 0.028 * np.sin(t)) for t in turn[::-1]]
    outer[-1], inner[0] = (0.0, 0.032), (0.0, 0.028)
    solid = revolve([*inner, *outer], sections=32)
    solid.fix_normals()
    return solid


def pointed() -> trimesh.Trimesh:
    return cone(0.028, 0.065, sections=32)


def plate() -> trimesh.Trimesh:
    return box((0.07, 0.008, 0.05))


def ring() -> trimesh.Trimesh:
    return torus(0.02, 0.011, major_sections=32, minor_sections=16)


MESHES: dict[str, Callable[[], trimesh.Trimesh]] = {
    "mug": mug,
    "bottle": bottle,
    "angle": angle,
    "wedge": wedge,
    "star": star,
    "bowl": bowl,
    "cone": pointed,
    "plate": plate,
    "torus": ring,
}


def write_mesh(name: str, folder: Path, ending: str = ".obj") -> Path:
    """Write one of them, return its path."""
    path = folder / f"{name}{ending}"
    MESHES[name]().export(path)
    return path
