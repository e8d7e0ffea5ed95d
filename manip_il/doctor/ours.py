"""Checks of what this program writes beside LeRobot's own: the spec, and the environment's fingerprint."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.fingerprint import compare_fingerprints, environment_fingerprint
from manip_il.data.info import Feature, Info, read_object
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, error, some, warning
from manip_il.errors import ManipError

_NEEDED = {"spec", "fingerprint", "provenance"}
_HASH = "_sha256"


def check_spec(dataset: Dataset) -> Iterator[Finding]:
    """Columns, names and rate are those of the robot and task that the dataset says it is about."""
    info = dataset.info
    if info is None:
        return
    if not dataset.is_ours:
        if {s.SIM_STATE, s.EXECUTED_ACTION} <= info.features.keys():
            yield warning(layout.OURS, "is missing (LeRobot's tools drop it): the task and the fingerprint are unknown")
        return
    try:
        spec = read_spec(dataset)
    except (OSError, ValueError, TypeError, RecursionError, ManipError) as problem:
        yield error(layout.OURS, f"cannot be read: {problem}")
        return
    for what, said, found in (("fps", spec.fps, info.fps), ("robot_type", spec.robot, info.robot)):
        if said != found:
            yield error(layout.INFO, f"{what} is {found!r}; {layout.OURS} says {said!r}")
    wanted = layout.all_features(spec)
    for key, feature in wanted.items():
        yield from _check_feature(key, feature, info)
    if extra := sorted(info.features.keys() - wanted.keys()):
        yield warning(layout.INFO, f"has {some(extra)} beside the columns of {spec.robot} {spec.task}")


def check_fingerprint(dataset: Dataset) -> Iterator[Finding]:
    """Yield the versions that the dataset was recorded with are those installed here."""
    if not dataset.is_ours:
        return
    try:
        fingerprint = read_object(dataset.root / layout.OURS).get("fingerprint")
    except (OSError, ValueError, RecursionError):
        return  # named by the check of the spec
    if not isinstance(fingerprint, dict) or not fingerprint:
        yield warning(layout.OURS, "has no fingerprint: what the dataset was recorded with is not known")
        return
    theirs = {str(key): value for key, value in fingerprint.items() if _is_version(str(key))}
    here = {key: value for key, value in environment_fingerprint(b"", {}).items() if _is_version(key)}
    for text in compare_fingerprints("the dataset", theirs, "this installation", here):
        yield warning(layout.OURS, text)


def read_spec(dataset: Dataset) -> s.RobotTaskSpec:
    """Return the spec in our own file.

    Raises `OSError`, `ValueError`, `TypeError` or `ManipError` for anything else.
    """
    ours = read_object(dataset.root / layout.OURS)
    if missing := _NEEDED - ours.keys():
        raise ValueError(f"it lacks {some(sorted(missing))}")
    if not isinstance(ours["spec"], dict):
        raise ValueError(f"its spec is {type(ours['spec']).__name__}; expected an object")
    return s.RobotTaskSpec.from_json(ours["spec"])


def _is_version(key: str) -> bool:
    """Whether an entry of a fingerprint names a program: another processor is nothing amiss with a dataset."""
    return not key.endswith(_HASH) and key != "processor"


def _check_feature(key: str, wanted: dict[str, Any], info: Info) -> Iterator[Finding]:
    found = info.features.get(key)
    if found is None:
        yield error(layout.INFO, f"features lack {key!r}, which every dataset of this program has")
        return
    for what, mine in (("dtype", wanted["dtype"]), ("shape", tuple(wanted["shape"])), ("names", wanted["names"])):
        theirs = getattr(found, what)
        if theirs != mine and not _is_same_picture(what, key, found):
            yield error(f"{layout.INFO}: {key}", f"{what} {_short(theirs)}; {layout.OURS} makes it {_short(mine)}")


def _is_same_picture(what: str, key: str, found: Feature) -> bool:
    """A camera may be stored as video or as pictures."""
    return what == "dtype" and key.startswith(s.IMAGES) and found.dtype == "image"


def _short(value: object) -> str:
    text = str(value)
    return text if len(text) <= 80 else f"{text[:77]}..."
