"""`eval.json`: one evaluation of one policy; reading and comparing evaluations."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import cached_property
from pathlib import Path, PurePath
from statistics import fmean
from typing import TYPE_CHECKING, Any

from manip_il import checks
from manip_il.data.atomic import write_json
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.intervals import CONFIDENCE, Proportion
from manip_il.option import NameOrPath
from manip_il.sim.conditions import NOMINAL, Condition
from manip_il.sim.shape import stored
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import complete

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob

FILE_NAME = "eval.json"
_MOST = 10**9  # of anything that is counted
# keys of every episode, in the order of `EpisodeResult`
_KEYS = {
    "seed": int,
    "success": bool,
    "success_at_end": bool,
    "steps": int,
    "return": float,
    "phase_at_end": str,
}


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """The outcome of one episode.

    Attributes:
        seed: The episode's seed.
        success: Whether the task was solved at some time.
        success_at_end: Whether it was solved at the last frame.
        steps: Control steps until the episode ended.
        ret: Sum of the rewards.
        phase_at_end: The expert's name for the phase of the last state.
        detail: Further keys of the JSON object.
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
        """The condition's name; empty if there is none."""
        return self.detail.get("condition", "")

    def to_json(self) -> dict[str, Any]:
        """Return the episode as stored in `eval.json`."""
        values = (
            self.seed,
            self.success,
            self.success_at_end,
            self.steps,
            self.ret,
            self.phase_at_end,
        )
        return dict(zip(_KEYS, values, strict=True)) | dict(self.detail)

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EpisodeResult:
        """Return the inverse of `to_json`.

        Raises `KeyError`, `TypeError` or `ValueError` if a value is missing or invalid.
        """
        detail = dict(data)
        values: list[Any] = [convert(detail.pop(key)) for key, convert in _KEYS.items()]
        checks.text("condition", detail.get("condition", ""))
        checks.text("task", detail.get("task", ""))
        checks.mapping("drawn", detail.get("drawn", {}))
        checks.number("steps_to_success", detail.get("steps_to_success") or 0)
        return cls(*values, detail=detail)


@dataclass(frozen=True, slots=True)
class EvalSettings:
    """The settings that two evaluations must share to be comparable, and that reproduce an episode.

    Attributes:
        horizon: Largest number of control steps of an episode.
        tolerance: Distance to the goal that counts as success [m].
        control_hz: Control steps per second [Hz].
        success_steps: Consecutive control steps within the tolerance that count as success.
        suite: Name of the conditions.
        conditions: The conditions, which episodes cycle through.
        hold: Control steps after success at which an episode ends; None if it continues to the
            horizon.
        object: Shape and size of the object to grasp; empty for the task's default.
    """

    horizon: int
    tolerance: float
    control_hz: int = 20
    success_steps: int = 5
    suite: str = NOMINAL.name
    conditions: tuple[Condition, ...] = (NOMINAL,)
    hold: int | None = None
    object: str = ""

    def __post_init__(self) -> None:
        hold = 0 if self.hold is None else self.hold
        for steps in (self.horizon, self.success_steps, self.control_hz, hold):
            checks.whole("horizon, success_steps, control_hz or hold", steps, 0, _MOST)
        checks.number("tolerance", self.tolerance)
        checks.text("suite", self.suite)
        checks.object_name(self.object)

    @classmethod
    def of(cls, job: RolloutJob, suite: str = NOMINAL.name) -> EvalSettings:
        """Return the settings of a job whose conditions are called `suite`."""
        env = job.env
        return cls(
            *(env.horizon, env.tolerance, env.control_hz, env.success_steps),
            *(suite, job.conditions or (NOMINAL,), job.hold, stored(env.object)),
        )

    @property
    def disturbance(self) -> str:
        """The conditions in words, `none` if all are nominal."""
        return (
            "; ".join(map(str, self.conditions))
            if any(one.ranges for one in self.conditions)
            else "none"
        )

    def to_json(self) -> dict[str, Any]:
        """Return plain JSON values."""
        plain = {name: getattr(self, name) for name in _SETTINGS}
        return plain | {"conditions": [condition.to_json() for condition in self.conditions]}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EvalSettings:
        """Return the inverse of `to_json`; raises what `EpisodeResult.from_json` does.

        Other keys are ignored.
        """
        values: dict[str, Any] = {name: data[name] for name in _SETTINGS}
        values["conditions"] = tuple(Condition(**ranges) for ranges in data["conditions"])
        return cls(**values)


_SETTINGS = tuple(field.name for field in fields(EvalSettings))


@dataclass(frozen=True)
class EvalResult:
    """One policy on one robot and task: every episode, and the statistics derived from them.

    Attributes:
        policy: Name of the policy.
        robot: Name of the robot.
        task: Name of the task.
        fingerprint: The environment's fingerprint.
        episodes: The episodes' results.
        settings: The settings that all episodes share.
        policy_sha256: Hash of the policy's files; empty if there are none.
        until_width: The interval width at which the evaluation was to stop (intervals are then
            valid at any stopping time); None if the number of episodes was fixed in advance.

    Raises:
        ManipError: if there is no episode, or a seed occurs twice.
    """

    policy: str
    robot: str
    task: str
    fingerprint: Mapping[str, Any]
    episodes: tuple[EpisodeResult, ...]
    settings: EvalSettings
    policy_sha256: str = ""
    until_width: float | None = None

    def __post_init__(self) -> None:
        if not self.episodes:
            raise ManipError(f"evaluation of {self.policy}: no episodes")
        seeds = len({episode.seed for episode in self.episodes})
        if seeds != len(self.episodes):
            raise ManipError(
                f"evaluation of {self.policy}: {len(self.episodes)} episodes on {seeds} seeds"
            )

    def env(
        self,
        robot: NameOrPath | None = None,
        task: NameOrPath | None = None,
        shape: NameOrPath | None = None,
    ) -> EnvConfig:
        """Return the environment of the evaluation.

        The user's own files must be given again, because results hold only their names.

        Args:
            robot: The user's own robot, if any.
            task: The user's own task, if any.
            shape: The user's own mesh of the object, if any.

        Raises:
            UnknownName: if the robot or the task is not built in and its file is not given.
            UsageError: if a setting is invalid.
        """
        of, limits = (
            self.settings,
            (self.settings.tolerance, self.settings.success_steps, self.settings.horizon),
        )
        return complete(
            EnvConfig(
                of.control_hz, *limits, robot or self.robot, task or self.task, shape or of.object
            )
        )

    @property
    def success(self) -> Proportion:
        """Share of episodes that succeeded at some time."""
        return self._share("success")

    @property
    def success_at_end(self) -> Proportion:
        """Share of episodes that were at the goal when they ended."""
        return self._share("success_at_end")

    def _share(self, outcome: str) -> Proportion:
        return Proportion.of(
            [getattr(episode, outcome) for episode in self.episodes], self.until_width is not None
        )

    @cached_property
    def by_condition(self) -> dict[str, EvalResult]:
        """Condition name -> its episodes, in the order of `settings`.

        "" for episodes without a condition.
        """
        return self._split("condition", [one.name for one in self.settings.conditions])

    @cached_property
    def by_task(self) -> dict[str, EvalResult]:
        """Task -> its episodes; {} if there is only one task."""
        return {name: part for name, part in sorted(self._split("task").items()) if name}

    def _split(self, key: str, first: Sequence[str] = ()) -> dict[str, EvalResult]:
        """The episodes by a value in their details, those of the values in `first` first."""
        parts: dict[str, list[EpisodeResult]] = {name: [] for name in first}
        for episode in self.episodes:
            parts.setdefault(episode.detail.get(key, ""), []).append(episode)
        return {
            name: replace(self, episodes=tuple(episodes))
            for name, episodes in parts.items()
            if episodes
        }

    @property
    def steps_to_success(self) -> float | None:
        """Mean control steps until the first success, over successful episodes.

        None if no episode records it.
        """
        steps = (
            episode.detail.get("steps_to_success") for episode in self.episodes if episode.success
        )
        known = [count for count in steps if count is not None]
        return fmean(known) if known else None

    @property
    def failures(self) -> dict[str, int]:
        """Failed episodes by the phase that they ended in, most frequent first."""
        phases = Counter(
            sorted(episode.phase_at_end for episode in self.episodes if not episode.success)
        )
        return dict(phases.most_common())  # ties keep the order of names

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `eval.json`."""
        tasks = {name: part.success.to_json() for name, part in self.by_task.items()}
        method = "Wilson's score interval"
        if self.until_width is not None:
            method = "confidence sequence: holds whenever one stops"
        return {
            "success_rate": self.success.rate,
            "interval": list(self.success.interval),
            "confidence": CONFIDENCE,
            "interval_method": method,
            "n_episodes": len(self.episodes),
            "success_at_end_rate": self.success_at_end.rate,
            "until_width": self.until_width,
            "by_condition": {
                name: part.success.to_json() for name, part in self.by_condition.items() if name
            },
            **({"by_task": tasks} if tasks else {}),
            "policy": self.policy,
            "policy_sha256": self.policy_sha256,
            "robot": self.robot,
            "task": self.task,
            "fingerprint": dict(self.fingerprint),
            "settings": self.settings.to_json(),
            "episodes": [episode.to_json() for episode in self.episodes],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EvalResult:
        """Return the inverse of `to_json`: rates and intervals are recomputed from the episodes.

        Raises `KeyError`, `TypeError` or `ValueError` if a value is missing or invalid.
        """
        width = data["until_width"]
        return cls(
            policy=checks.text("policy", data["policy"]),
            # Older files store the path of a user's own robot, which is named like its file.
            robot=checks.name("robot", PurePath(checks.text("robot", data["robot"])).stem),
            task=checks.task_name(data["task"]),
            fingerprint=checks.mapping("fingerprint", data["fingerprint"]),
            episodes=tuple(map(EpisodeResult.from_json, data["episodes"])),
            settings=EvalSettings.from_json(checks.mapping("settings", data["settings"])),
            policy_sha256=checks.text("policy_sha256", data["policy_sha256"]),
            until_width=None if width is None else checks.number("until_width", width),
        )

    def write(self, path: Path) -> None:
        """Write `path` atomically, creating its folder."""
        write_json(path, self.to_json())

    @classmethod
    def read(cls, path: Path) -> EvalResult:
        """Read what `write` wrote.

        Raises `ManipError` for a file that is missing, truncated or of another kind.

        `path` may be the folder that contains `eval.json`.
        """
        path = path / FILE_NAME if path.is_dir() else path
        data = checks.read_json(path, f"an {FILE_NAME} of manip-il eval")
        try:
            return cls.from_json(data)
        except (
            KeyError,
            TypeError,
            ValueError,
            ArithmeticError,
            AttributeError,
            ManipError,
        ) as error:
            why = "it has no key " * isinstance(error, KeyError) + checks.one_line(error)
            raise ManipError(f"{path}: not an {FILE_NAME}: {why}") from error


def require_equal(left: str, one: object, right: str, other: object, *names: str) -> None:
    """Check that some attributes of two objects are equal.

    Args:
        left: Name of the first object, for the message.
        one: The first object.
        right: Name of the second object, for the message.
        other: The second object.
        names: The attributes to compare, in this order.

    Raises:
        MismatchError: for the first attribute that differs.
    """
    for name in names:
        ours, theirs = getattr(one, name), getattr(other, name)
        if ours != theirs:
            raise MismatchError(name, left, ours, right, theirs)


def require_comparable(left: str, one: EvalResult, right: str, other: EvalResult) -> None:
    """Check that two evaluations agree in robot, task and settings.

    Args:
        left: Name of the first evaluation, for the message.
        one: The first evaluation.
        right: Name of the second evaluation, for the message.
        other: The second evaluation.

    Raises:
        MismatchError: for the first difference.
    """
    require_equal(left, one, right, other, "robot", "task")
    require_equal(left, one.settings, right, other.settings, *_SETTINGS)
