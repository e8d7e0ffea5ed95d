"""An object's mesh, read from an STL or OBJ file."""

from __future__ import annotations

import hashlib
import re
from dataclasses import dataclass
from functools import cache
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import UsageError, shorten

_TEXT = re.compile(r"mesh:(?P<path>.+?\.(?i:stl|obj)(?P<hash>#[0-9a-f]{12})?)(?P<length>:\d*\.?\d+)?", re.DOTALL)


@dataclass(frozen=True, eq=False)
class Mesh:
    """A closed mesh with its centre of mass at the origin: vertices (n, 3) [m], faces (m, 3), volume [m^3].

    sha256: hash of the file. text: the value of --task.object, with the file's path; stored: as in datasets, with the
    file's name and hash in place of its path.
    """

    text: str
    stored: str
    sha256: str
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    volume: float

    @property
    def lengths(self) -> tuple[float, float, float]:
        """Lengths along the file's axes [m]."""
        x, y, z = np.ptp(self.vertices, axis=0).tolist()
        return x, y, z


def parse_mesh(text: str) -> Mesh:
    """Return the mesh of `mesh:PATH` or `mesh:PATH:LENGTH`, read once per process.

    LENGTH: its longest side [m]; if omitted, the file is in metres. Raises `UsageError`.
    """
    if (found := _TEXT.fullmatch(text)) is None:
        raise UsageError(f"object is {shorten(text)}; expected mesh:FILE or mesh:FILE:LENGTH [m], FILE an STL or OBJ")
    if found["hash"]:
        give = re.sub(r"^mesh:(.*)#[0-9a-f]{12}", r"mesh:PATH/\1", text)
        raise UsageError(f"object {text}: only the name of the mesh was stored; give --task.object={give}")
    return _read(found["path"], float((found["length"] or ":0")[1:]))


def mesh_path(text: str) -> str | None:
    """Return the path in the text of a mesh, as in `parse_mesh`; None for any other text."""
    found = _TEXT.fullmatch(text)
    return found["path"] if found else None


def is_stored(text: str) -> bool:
    """Return whether a text has a mesh file's name and hash, as in datasets, instead of its path."""
    found = _TEXT.fullmatch(text)
    return bool(found and found["hash"])


@cache
def _read(name: str, length: float) -> Mesh:
    path = Path(name)
    content = checks.read_bytes(path, "a mesh, an STL or OBJ file", UsageError)
    solid = _solid(name, content, path.suffix.lower())
    scale = length / solid.extents.max() if length else 1.0
    vertices, volume = (solid.vertices - solid.center_mass) * scale, float(solid.volume) * scale**3
    digest = hashlib.sha256(content).hexdigest()
    ending = f":{length:g}" if length else ""
    text, stored = f"mesh:{name}{ending}", f"mesh:{path.name}#{digest[:12]}{ending}"
    return Mesh(text, stored, digest, vertices, np.asarray(solid.faces), volume)


def _solid(name: str, content: bytes, suffix: str) -> Any:
    """The closed surface in a file, with its faces outwards; raises `UsageError`."""
    import trimesh  # imported here because it takes a third of a second

    try:
        found = trimesh.load_mesh(
            BytesIO(content), file_type=suffix[1:], **({"skip_materials": True} if suffix == ".obj" else {})
        )
        solid = trimesh.Trimesh(found.vertices, found.faces)
    except Exception as error:
        raise UsageError(f"{name} cannot be read as a mesh: {checks.one_line(error)}") from error
    if not solid.is_watertight:
        raise UsageError(f"{name} is not closed; close its holes in a mesh editor")
    solid.fix_normals(multibody=False)
    return solid
