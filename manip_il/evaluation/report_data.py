"""Results, curves and pictures that a report shows, independent of HTML and of the terminal."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np

from manip_il.errors import ManipError
from manip_il.evaluation.intervals import Proportion
from manip_il.evaluation.results import EvalResult
from manip_il.mdp import F64, require_finite

Kind = Literal["expert", "dagger", "cloning", "baseline"]
Cost = Literal["labels", "episodes", "steps", "seconds"]
COSTS: tuple[Cost, ...] = ("labels", "episodes", "steps", "seconds")
PNG_MAGIC = b"\x89PNG\r\n\x1a\n"
JPEG_MAGIC = b"\xff\xd8\xff"


@dataclass(frozen=True)
class PolicyRow:
    """One policy's line in the table. labels: expert labels that it learnt from, None for the expert itself.

    success: at some time; success_at_end: at the last frame; steps_to_success: mean [control steps];
    disturbed: success under the disturbance, where measured. kind: decides the colour.
    """

    name: str
    success: Proportion
    labels: int | None = None
    success_at_end: Proportion | None = None
    steps_to_success: float | None = None
    disturbed: Proportion | None = None
    kind: Kind = "dagger"

    @classmethod
    def of(
        cls,
        name: str,
        result: EvalResult,
        labels: int | None = None,
        disturbed: EvalResult | None = None,
        kind: Kind = "dagger",
    ) -> PolicyRow:
        """Return a row from one evaluation, and a second one under a disturbance where there is one."""
        again = disturbed.success if disturbed else None
        return cls(name, result.success, labels, result.success_at_end, result.steps_to_success, again, kind)


@dataclass(frozen=True)
class CurvePoint:
    """Validation success of one policy that learnt from `labels` expert labels; `name` such as `round 3`.

    episodes, steps, seconds: its other costs, where known; simulated control steps, seconds of collecting and fitting.
    """

    labels: int
    success: Proportion
    name: str = ""
    episodes: int | None = None
    seconds: float | None = None
    steps: int | None = None

    def __post_init__(self) -> None:
        for cost in COSTS:
            amount = self.amount(cost)
            if amount is not None and amount < 0:
                raise ManipError(f"a learning curve's point has {amount} {cost}; expected 0 or more")

    def amount(self, cost: Cost) -> float | None:
        """Return labels, episodes, steps or seconds; None where not known."""
        return getattr(self, cost)


@dataclass(frozen=True)
class LearningCurve:
    """Validation success of a run's rounds in order, and of cloning at labels of its own. name: of the algorithm."""

    dagger: tuple[CurvePoint, ...]
    cloning: tuple[CurvePoint, ...] = ()
    name: str = "DAgger"


@dataclass(frozen=True)
class Strip:
    """One episode of one policy as pictures: (time [s], PNG bytes) in order. success: None where not known."""

    policy: str
    frames: tuple[tuple[float, bytes], ...]
    caption: str = ""
    success: bool | None = None

    def __post_init__(self) -> None:
        for seconds, picture in self.frames:
            if not picture.startswith(PNG_MAGIC):
                raise ManipError(
                    f"picture strip of {self.policy}: frame at {seconds:.2f} s is not a PNG (starts {picture[:8]!r})"
                )


@dataclass(frozen=True)
class Film:
    """One episode, or several in a row, of one policy as an MP4 (H.264).

    success: None where not known. poster: a JPEG shown until it plays.
    """

    policy: str
    mp4: bytes
    caption: str = ""
    success: bool | None = None
    poster: bytes = b""

    def __post_init__(self) -> None:
        if self.mp4[4:8] != b"ftyp":
            raise ManipError(f"film of {self.policy}: not an MP4 (starts {self.mp4[:8]!r})")
        if self.poster and not self.poster.startswith(JPEG_MAGIC):
            raise ManipError(f"film of {self.policy}: the poster is not a JPEG (starts {self.poster[:8]!r})")


@dataclass(frozen=True, eq=False)
class Paths:
    """Positions of hand and object in one episode: a picture that needs no renderer.

    hand, obj: (T, 3) positions [m] in the world frame; goal: (3,) [m], None where the task has none; dt: between rows
    [s]. success: None where not known.
    """

    policy: str
    hand: F64
    obj: F64
    goal: F64 | None
    dt: float = 0.0
    caption: str = ""
    success: bool | None = None

    def __post_init__(self) -> None:
        goal = {} if self.goal is None else {"goal": np.shape(self.goal)}
        shapes = {"hand": np.shape(self.hand), "obj": np.shape(self.obj), **goal}
        steps = shapes["hand"][0] if shapes["hand"] else 0
        if shapes != {"hand": (steps, 3), "obj": (steps, 3), **dict.fromkeys(goal, (3,))} or steps == 0:
            raise ManipError(f"paths of {self.policy}: shapes {shapes}; expected hand and obj (T, 3), goal (3,)")
        for name in shapes:
            require_finite(f"paths of {self.policy}, {name}", np.asarray(getattr(self, name)))


def flatten(tree: Mapping[str, Any], prefix: str = "") -> dict[str, str]:
    """Return a nested mapping as `policy.hidden -> 256`: the names that the command line takes."""
    flat: dict[str, str] = {}
    for key, value in tree.items():
        name = f"{prefix}{key}"
        if isinstance(value, Mapping) and value:
            flat |= flatten(value, f"{name}.")
        else:
            flat[name] = _plain(value)
    return flat


def format_seconds(seconds: float) -> str:
    """Return a duration as `4.2 s`, `3 min 20 s` or `1 h 05 min`."""
    if seconds < 60:
        return f"{seconds:.1f} s"
    minutes, rest = divmod(round(seconds), 60)
    if minutes < 60:
        return f"{minutes} min {rest:02d} s"
    return f"{minutes // 60} h {minutes % 60:02d} min"


def format_amount(cost: Cost, amount: float) -> str:
    """Return `8,012 labels`, `150 episodes`, `8,012 steps` or `3 min 20 s`."""
    return format_seconds(amount) if cost == "seconds" else f"{amount:,.0f} {cost}"


def _plain(value: object) -> str:
    if value is None:
        return "none"
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, list | tuple):
        return ", ".join(_plain(item) for item in value) or "(empty)"
    if isinstance(value, Mapping):
        return "(empty)"
    return str(value)
