"""An object's mesh, read from an STL or OBJ file."""

import hashlib
import re
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.errors import UsageError, shorten
from manip_il.mdp import F64, I64
from manip_il.option import NameOrPath

_TEXT = re.compile(r"mesh:(?P<path>.+?\.(?i:stl|obj))(?P<length>:\d*\.?\d+)?", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed mesh with its centre of mass at the origin.

    Attributes:
        stored: The object's text in datasets, with the file's name and hash in place of its path.
        sha256: Hash of the file.
        vertices: Positions of the vertices, (n, 3) [m].
        faces: Indices of the vertices of each triangle, (m, 3).
        volume: Volume [m^3].
    """

    stored: str
    sha256: str
    vertices: F64
    faces: I64
    volume: float

    @property
    def lengths(self) -> tuple[float, float, float]:
        """Lengths along the file's axes [m]."""
        x, y, z = np.ptp(self.vertices, axis=0).tolist()
        return x, y, z


def parse_mesh(shape: Path) -> Mesh:
    """Return the mesh that a text names, read once per process.

    Args:
        shape: `mesh:PATH` or `mesh:PATH:LENGTH`, with the length of its longest side [m]; if that
            is omitted, the file is in metres.

    Raises:
        UsageError: If the text does not have this form, or the file cannot be read as a closed
            mesh.
    """
    text = str(shape)
    if (found := _TEXT.fullmatch(text)) is None:
        raise UsageError(
            f"object is {shorten(text)}; expected mesh:FILE or mesh:FILE:LENGTH [m], FILE an STL"
            " or OBJ"
        )
    return _read(Path(found["path"]), float((found["length"] or ":0")[1:]))


def mesh_path(shape: NameOrPath) -> Path | None:
    """Return the path in an object's text, as in `parse_mesh`.

    None for an object without a file.
    """
    found = _TEXT.fullmatch(str(shape)) if isinstance(shape, Path) else None
    return Path(found["path"]) if found else None


@cache
def _read(path: Path, length: float) -> Mesh:
    content = checks.read_bytes(path, "a mesh, an STL or OBJ file", UsageError)
    solid = _solid(path, content)
    scale = length / solid.extents.max() if length else 1.0
    vertices, volume = (solid.vertices - solid.center_mass) * scale, float(solid.volume) * scale**3
    digest = hashlib.sha256(content).hexdigest()
    ending = f":{length:g}" if length else ""
    stored = f"mesh:{path.name}#{digest[:12]}{ending}"
    return Mesh(stored, digest, vertices, np.asarray(solid.faces), volume)


def _solid(path: Path, content: bytes) -> Any:
    """The closed surface in a file, with its faces outwards; raises `UsageError`."""
    import trimesh  # imported here because it takes a third of a second

    suffix = path.suffix.lower()
    try:
        found = trimesh.load_mesh(
            BytesIO(content),
            file_type=suffix[1:],
            **({"skip_materials": True} if suffix == ".obj" else {}),
        )
        solid = trimesh.Trimesh(found.vertices, found.faces)
    except Exception as error:
        raise UsageError(f"{path} cannot be read as a mesh: {checks.one_line(error)}") from error
    if not len(solid.faces):
        raise UsageError(f"{path} is empty: it has no triangles")
    if not solid.is_watertight:
        raise UsageError(f"{path} is not closed; close its holes in a mesh editor")
    solid.fix_normals(multibody=False)
    return solid
