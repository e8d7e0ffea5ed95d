"""Shapes and sizes of the object that a task moves, as text: `cylinder:0.04`,
`box:0.06x0.03x0.03`.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.errors import UnknownName, UsageError, shorten
from manip_il.option import NameOrPath

if TYPE_CHECKING:
    from manip_il.sim.mesh import Mesh

SHORTEST, LONGEST = 0.02, 0.12  # range of an object's lengths [m]
DEFAULT_WIDTH = 0.05  # if none is given [m]
LIGHTEST = 0.05  # [kg]: contact with less is soft, and a held object creeps out of the hand
DENSITY = 800.0  # [kg/m^3]: a cube of 5 cm weighs 0.1 kg
_CAPSULE = 1.5  # default length of a capsule, in diameters
_SIZES = {
    "box": "EDGE or LENGTHxWIDTHxHEIGHT",
    "cylinder": "DIAMETER or DIAMETERxLENGTH",
    "sphere": "DIAMETER",
    "capsule": "DIAMETER or DIAMETERxLENGTH",
}
KINDS = tuple(_SIZES)
ANY = "any"  # one of `KINDS` in each episode
_SIZES[ANY] = "WIDTH"
MESH = "mesh"
LONGEST_MESH = 0.2  # [m]
SHAPE_HELP = (
    "box, cylinder, sphere, capsule or any (one of these in each episode), with lengths [m] as in"
    " cylinder:0.04x0.08, box:0.06x0.03x0.03; or a mesh file with the length of its longest side,"
    " mesh:mug.obj:0.1"
)


@dataclass(frozen=True)
class ObjectShape:
    """A wooden solid, or a mesh.

    Cylinders and capsules have their axis along z, and a capsule's length is that between the tips
    of its round ends.

    Attributes:
        kind: One of `KINDS`, `mesh`, or `any`: each episode draws one of `KINDS`, of the same
            width; a cube if nothing is drawn.
        lengths: Lengths along its own axes x, y and z, (3,) [m].
        mesh: The mesh, if it is one.

    Raises:
        UsageError: If a length is outside `SHORTEST` to `LONGEST` (for a mesh, only the longest
            counts, and it may be `LONGEST_MESH`), or a capsule is no longer than wide.
    """

    kind: str
    lengths: tuple[float, float, float]
    mesh: Mesh | None = None

    def __post_init__(self) -> None:
        if self.mesh is not None:
            if not SHORTEST <= max(self.lengths) <= LONGEST_MESH:
                raise UsageError(
                    f"{self.mesh.stored} is {max(self.lengths):.3g} m long; expected {SHORTEST} to"
                    f" {LONGEST_MESH} m: give the length of its longest side, as in"
                    " mesh:mug.obj:0.1"
                )
            return
        for length in self.lengths:
            if not SHORTEST <= length <= LONGEST:
                raise UsageError(
                    f"{self.kind} has a length of {length:g} m; expected {SHORTEST} to {LONGEST} m"
                )
        if self.kind == "capsule" and self.lengths[2] <= self.lengths[0]:
            raise UsageError(
                f"capsule is {self.lengths[2]:g} m long and {self.lengths[0]:g} m wide; it must be"
                " longer than wide"
            )

    @classmethod
    def parse(cls, text: NameOrPath) -> ObjectShape:
        """Return the shape that a text describes, or a mesh.

        Args:
            text: A shape as in `SHAPE_HELP`; only a `Path` can name a mesh (see `option.typed`).

        Raises:
            UnknownName: If there is no such shape.
            UsageError: If its lengths are wrong, or its mesh cannot be read.
        """
        if isinstance(text, Path):
            from manip_il.sim.mesh import parse_mesh  # imported here: help needs no numpy

            mesh = parse_mesh(text)
            return cls(MESH, mesh.lengths, mesh)
        kind, colon, size = text.partition(":")
        if kind == MESH:
            give = re.sub(r"^mesh:(?:.*/)?([^#]*)(#[0-9a-f]*)?", r"mesh:PATH/\1", text)
            raise UsageError(
                f"object {text}: only the name of the mesh was stored; give --task.object={give}"
            )
        if kind not in _SIZES:
            raise UnknownName("shape", kind, (*_SIZES, "mesh:FILE"))
        try:
            numbers = [float(number) for number in size.split("x")] if colon else [DEFAULT_WIDTH]
            return cls(kind, _lengths(kind, *numbers))
        except (ValueError, TypeError):
            raise UsageError(
                f"object is {shorten(text)}; expected {kind}:{_SIZES[kind]} [m]"
            ) from None

    @classmethod
    def of_width(cls, kind: str, width: float) -> ObjectShape:
        """Return a cube, a sphere, a cylinder as long as wide, or a capsule 1.5 times as long.

        Args:
            kind: One of `KINDS`, or `any`.
            width: Its width [m].

        Raises:
            UsageError: If a length is out of range.
        """
        return cls(kind, _lengths(kind, width))

    def __str__(self) -> str:
        """Shortest text that `parse` reads as this shape; for a mesh, its text in datasets."""
        if self.mesh is not None:
            return self.mesh.stored
        numbers = self.lengths if self.kind == "box" else self.lengths[::2]
        if _lengths(self.kind, self.lengths[0]) == self.lengths:
            numbers = self.lengths[:1]
        return f"{self.kind}:{'x'.join(f'{length:.12g}' for length in numbers)}"

    @property
    def size(self) -> tuple[float, ...]:
        """MuJoCo's `geom_size` of the shape [m]."""
        width, _, length = self.lengths
        if self.kind in ("box", ANY):
            return tuple(edge / 2 for edge in self.lengths)
        if self.kind == "sphere":
            return (width / 2,)
        return width / 2, (length - width if self.kind == "capsule" else length) / 2

    @property
    def mass(self) -> float:
        """Mass [kg]."""
        if self.mesh is not None:
            return max(LIGHTEST, DENSITY * self.mesh.volume)
        width, depth, length = self.lengths
        disc, ball = math.pi / 4 * width**2, math.pi / 6 * width**3
        volumes = {
            "cylinder": disc * length,
            "sphere": ball,
            "capsule": disc * (length - width) + ball,
        }
        return max(LIGHTEST, DENSITY * volumes.get(self.kind, width * depth * length))

    @property
    def word(self) -> str:
        """The object's name in an instruction."""
        if self.kind in (ANY, MESH):
            return "object"
        return "cube" if self.kind == "box" and len(set(self.lengths)) == 1 else self.kind

    @property
    def sizes(self) -> tuple[float, float] | None:
        """Range of `2 * max(size)` [m] in which the object can be grasped however it lies.

        The object is scaled as a whole. None if that range is empty.
        """
        if self.mesh is not None:
            return None
        (least, between, most), edge = sorted(self.lengths), 2 * max(self.size)
        low, high = edge * _THINNEST / least, edge * min(_WIDEST / between, LONGEST / most)
        return (low, high) if low < high else None


def _lengths(
    kind: str, first: float, second: float | None = None, *rest: float
) -> tuple[float, float, float]:
    """Lengths along the axes of a shape, from the numbers given.

    Raises `TypeError` for a wrong count.
    """
    if kind == "box" and (second is None) != (len(rest) == 1):
        return first, first if second is None else second, rest[0] if rest else first
    if rest or (second is not None and kind in ("box", "sphere", ANY)):
        raise TypeError(kind)
    longer = first * _CAPSULE if kind == "capsule" else first
    return first, first, longer if second is None else second


def draws_shape(text: NameOrPath) -> bool:
    """Return whether an object's shape is drawn anew in each episode.

    Args:
        text: The object, as in `ObjectShape.parse`.
    """
    return str(text).partition(":")[0] == ANY


def stored(text: NameOrPath) -> str:
    """Return an object's text as datasets store it.

    For a mesh, the file's name and hash replace its path.

    Args:
        text: The object, as in `ObjectShape.parse`.
    """
    return str(ObjectShape.parse(text)) if isinstance(text, Path) else text


# rolling friction of round objects, as on a cloth: dropped ones stay within reach [m]
ROLLING = 0.005
ROLLING_MESH = 0.001  # rolling friction of a mesh, which with more would balance on an edge [m]


def contact(kind: str) -> tuple[int, float]:
    """Return MuJoCo's `condim` and rolling friction [m] for an object of a kind."""
    if kind == MESH:
        return 6, ROLLING_MESH
    return (4, 0.0001) if kind in ("box", ANY) else (6, ROLLING)


# bounds on a scaled object: least length, greatest width between fingers [m]
_THINNEST, _WIDEST = 0.02, 0.07
CUBE = ObjectShape("box", (DEFAULT_WIDTH, DEFAULT_WIDTH, DEFAULT_WIDTH))
