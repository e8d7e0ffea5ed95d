"""One episode of `eval.json`, and the settings that all its episodes share.

Places and condition are optional: files of older versions and of other tools may lack them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any, Literal

from manip_il.sim.conditions import NOMINAL, Condition

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.sim.config import EnvConfig

Place = tuple[float, float, float]  # x away from the robot, y to its left, z above the table's top [m]
# Of every episode, in the order of `EpisodeResult`.
_KEYS = {"seed": int, "success": bool, "success_at_end": bool, "steps": int, "return": float, "phase_at_end": str}


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One episode: `success` at some time, `success_at_end` at the last frame, `ret` the sum of rewards.

    steps: control steps until the episode ended. phase_at_end: the expert's name for the last state.
    detail: further keys of the JSON object.
    """

    seed: int
    success: bool
    success_at_end: bool
    steps: int
    ret: float
    phase_at_end: str = ""
    detail: Mapping[str, Any] = field(default_factory=dict[str, Any])

    @property
    def condition(self) -> str:
        """The condition's name; empty if none is given."""
        name = self.detail.get("condition")
        return name if isinstance(name, str) else ""

    @property
    def start(self) -> Place | None:
        """Start of the object, or of the hand if the task has no object [m]."""
        return self._moving_thing("start")

    @property
    def end(self) -> Place | None:
        """End of the same [m]."""
        return self._moving_thing("end")

    @property
    def goal(self) -> Place | None:
        """Goal of the same [m]."""
        return _place(self.detail.get("goal"))

    def _moving_thing(self, when: Literal["start", "end"]) -> Place | None:
        places = self.detail.get(when)
        return _place(places.get("object", places.get("hand"))) if isinstance(places, Mapping) else None

    def to_json(self) -> dict[str, Any]:
        """Return the episode as `eval.json` holds it."""
        values = (self.seed, self.success, self.success_at_end, self.steps, self.ret, self.phase_at_end)
        detail = {key: value for key, value in self.detail.items() if key not in _KEYS}
        return dict(zip(_KEYS, values, strict=True)) | detail

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EpisodeResult:
        """Return the inverse of `to_json`; `KeyError` or `TypeError` if a value is missing or of another kind."""
        known = {"success_at_end": data["success"], "phase_at_end": ""} | {
            key: data[key] for key in data if key in _KEYS
        }
        values: list[Any] = [convert(known[key]) for key, convert in _KEYS.items()]
        return cls(*values, detail={key: value for key, value in data.items() if key not in _KEYS})


@dataclass(frozen=True, slots=True)
class EvalSettings:
    """The settings that two evaluations must share to be compared, and that repeating an episode needs.

    horizon, success_steps: control steps. tolerance: distance to the goal that counts as success [m]. suite: the name
    of the conditions, which episodes take in turn. hold: control steps after success at which an episode ends, None
    if it goes on to the horizon. object: shape and size of what is grasped, reward: of `carry`, empty for the task's
    own.
    """

    horizon: int
    tolerance: float
    control_hz: int = 20  # and five steps, in files without them
    success_steps: int = 5
    suite: str = NOMINAL.name
    conditions: tuple[Condition, ...] = (NOMINAL,)
    hold: int | None = None
    object: str = ""
    reward: str = ""

    @classmethod
    def of(cls, job: RolloutJob, suite: str = NOMINAL.name) -> EvalSettings:
        """Return those of a job whose conditions are called `suite`."""
        env, conditions = job.env, job.conditions or (NOMINAL,)
        steps, hz = env.success_steps, env.control_hz
        return cls(env.horizon, env.tolerance, hz, steps, suite, conditions, job.hold, env.object, env.reward)

    def env(self, robot: str, task: str) -> EnvConfig:
        """Return the environment that was evaluated in."""
        from manip_il.sim.config import EnvConfig

        limits = self.tolerance, self.success_steps, self.horizon
        return EnvConfig(robot, task, self.control_hz, *limits, self.object, self.reward)

    @property
    def disturbance(self) -> str:
        """The conditions in words, `none` if all are nominal."""
        return "; ".join(map(str, self.conditions)) if any(one.ranges for one in self.conditions) else "none"

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        plain = ("horizon", "tolerance", "control_hz", "success_steps", "hold", "suite")
        conditions = [condition.to_json() for condition in self.conditions]
        own = {key: getattr(self, key) for key in ("object", "reward") if getattr(self, key)}
        return {key: getattr(self, key) for key in plain} | {"conditions": conditions} | own

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EvalSettings:
        """Return the inverse of `to_json`; raises as `EpisodeResult.from_json`. Other keys are ignored."""
        known = {field.name: data[field.name] for field in fields(cls) if field.name in data}
        named = [dict(one) for one in known.pop("conditions", [NOMINAL.to_json()])]
        return cls(**known, conditions=tuple(Condition.from_mapping(one.pop("name"), one) for one in named))


def _place(given: Any) -> Place | None:
    if not isinstance(given, list | tuple) or len(given) != 3:
        return None
    if not all(isinstance(value, int | float) and math.isfinite(value) for value in given):
        return None
    x, y, z = map(float, given)
    return x, y, z
