"""Files of a MuJoCo model: read, mended where the YAML says so, and what identifies them."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Self

import mujoco

from manip_il import checks
from manip_il.errors import ManipError, UsageError
from manip_il.robots.reading import place

KEYS = ("model", "includes", "meshes", "mend")  # of a YAML
_MOST_MENDED = 10_000  # of a text that is mended [characters]


@dataclass(frozen=True)
class ModelFiles:
    """An MJCF and what it needs; paths are absolute.

    includes, meshes: folders of what it includes and of its meshes. mend: text of the file, and what MuJoCo reads in
    its place: for a file of somebody else's that does not compile.
    """

    model: Path
    includes: Path | None = None
    meshes: Path | None = None
    mend: Mapping[str, str] = field(default_factory=dict, hash=False)

    @classmethod
    def read(cls, what: str, tree: Mapping[str, Any], folder: Path) -> Self:
        """Make it of what YAML holds in a folder; `ManipError` names what is wrong."""
        folders = {key: place(what + key, tree[key], folder) for key in ("includes", "meshes") if key in tree}
        mend = checks.mapping(f"{what}mend", tree.get("mend", {}))
        texts = {
            checks.text(f"a text in {what}mend", old, _MOST_MENDED): ""
            if new == ""
            else checks.text(f"{what}mend", new)
            for old, new in mend.items()
        }
        return cls(place(f"{what}model", tree["model"], folder), **folders, mend=texts)

    def load(self, robot: str) -> mujoco.MjSpec:
        """Read the model with its includes and meshes. Raises `UsageError` where MuJoCo cannot; robot: its name."""
        try:
            text = self._text()  # before MuJoCo: it does not say why a file cannot be read
            if self.includes is None and self.meshes is None:
                if not self.mend:
                    return mujoco.MjSpec.from_file(str(self.model))
                spec = mujoco.MjSpec.from_string(text)
                spec.modelfiledir = str(self.model.parent)
                return spec
            included = {one.name: one.read_bytes() for one in self._included()}
            spec = mujoco.MjSpec.from_string(text, include=included, assets=self._assets())
        except (OSError, ValueError) as error:
            raise UsageError(f"robot {robot}: cannot read {self.model}: {' '.join(str(error).split())}") from None
        spec.meshdir = ""
        return spec

    def content(self) -> tuple[list[tuple[str, int]], list[bytes]]:
        """Return what identifies them: names and sizes of the meshes, and the texts."""
        files = sorted((name, path.stat().st_size) for name, path in self.mesh_files().items())
        return files, [one.read_bytes() for one in (self.model, *self._included())]

    def mesh_files(self) -> dict[str, Path]:
        """Return the model's meshes by name: of the folder that is given, else those that the model names."""
        if self.meshes or self.includes:
            folder = self.meshes or self.model.parent
            return {str(one.relative_to(folder)): one for one in folder.rglob("*.stl")}
        spec = self.load("")
        return {mesh.file: self.model.parent / spec.meshdir / mesh.file for mesh in spec.meshes if mesh.file}

    def _text(self) -> str:
        text = self.model.read_text()
        for old, new in self.mend.items():
            if old not in text:
                raise ManipError(f"{self.model} has no text {checks.shorten(old)} to mend")
            text = text.replace(old, new)
        return text

    def _included(self) -> list[Path]:
        return sorted((self.includes or self.model.parent).glob("*.xml"))

    def _assets(self) -> dict[str, bytes]:
        return {name: one.read_bytes() for name, one in self.mesh_files().items()}
