"""Find the policy in a `pretrained_model` folder, a checkpoint or a run."""

from __future__ import annotations

import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from manip_il.errors import UsageError

_PLACES = (".", "pretrained_model", "best/pretrained_model", "checkpoints/last/pretrained_model")
_NEWEST = ("checkpoints/*/pretrained_model", "round_*/policy/checkpoints/*/pretrained_model")
_REPO = re.compile(r"[A-Za-z0-9_][\w.-]*/[A-Za-z0-9_][\w.-]*")


def find_policy(path: Path) -> Path:
    """Return `path` if it is a `pretrained_model` folder, else the best or newest one in this checkpoint or run.

    Raises `UsageError` if there is none.
    """
    for place in _PLACES:
        if (path / place / "config.json").is_file():
            return path / place
    for place in _NEWEST:
        if found := sorted(path.glob(f"{place}/config.json")):
            return found[-1].parent
    wanted = f"LeRobot's pretrained_model folder, or a run that holds one{hub_hint(path)}"
    raise UsageError(f"no policy in {path}; expected {wanted}")


def hub_hint(path: Path, kind: str = "") -> str:
    """Return how to pull `path` if it looks like a Hub repository, else "". kind: `datasets/` for a dataset."""
    if path.exists() or path.parent.exists() or not _REPO.fullmatch(str(path)):
        return ""
    return f"; if it is on the Hub, get it by manip-il pull hf://{kind}{path} FOLDER and give that FOLDER"


def policy_folder(policy: Any) -> Path:
    """Return the `pretrained_model` folder of a `Checkpoint`, or of a path that `find_policy` takes."""
    return find_policy(Path(getattr(policy, "path", policy)).expanduser())


def with_folder(options: Mapping[str, Any]) -> dict[str, Any]:
    """Return the options of a fit's policy, with the `pretrained_model` folder that a `path` among them leads to."""
    path = options.get("path")
    return dict(options) if path is None else {**options, "path": str(policy_folder(path))}
