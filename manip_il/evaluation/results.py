"""`eval.json`: what one evaluation of one policy found, and how to read it back."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il import checks
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.statistics import CONFIDENCE, PairedComparison, Proportion, compare_paired
from manip_il.mdp import LONGEST_EPISODE
from manip_il.sim.conditions import NOMINAL, Condition

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob
    from manip_il.sim.env import EnvConfig

FILE_NAME = "eval.json"
_HZ, _STEPS = 20, 5  # of files that do not say them
_MOST_CONDITIONS = 100  # of a suite
WILSON = "Wilson's score interval"
ANYTIME = "confidence sequence: holds whenever one stops"


@dataclass(frozen=True, slots=True)
class EpisodeResult:
    """One episode: `success` at some time, `success_at_end` at the last frame, `ret` the sum of rewards.

    steps: control steps until the episode ended. phase_at_end: the expert's name for the last state.
    """

    seed: int
    success: bool
    success_at_end: bool
    steps: int
    ret: float
    phase_at_end: str = ""
    detail: Mapping[str, Any] = field(default_factory=dict[str, Any])  # further keys of the JSON object

    def to_json(self) -> dict[str, Any]:
        """Return the episode as `eval.json` holds it."""
        own = {
            "seed": self.seed,
            "success": self.success,
            "success_at_end": self.success_at_end,
            "steps": self.steps,
            "return": self.ret,
            "phase_at_end": self.phase_at_end,
        }
        return own | {key: value for key, value in self.detail.items() if key not in own}

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EpisodeResult:
        """Return the inverse of `to_json`; `ManipError` or `KeyError` where a value is amiss or missing."""
        data = checks.mapping("an episode", data)
        known = ("seed", "success", "success_at_end", "steps", "return", "phase_at_end")
        detail = {key: value for key, value in data.items() if key not in known}
        if detail.get("steps_to_success") is not None:
            checks.whole("steps_to_success", detail["steps_to_success"], 0, LONGEST_EPISODE)
        if "condition" in detail:
            checks.text("condition", detail["condition"], checks.LONGEST_NAME)
        if "drawn" in detail:
            checks.mapping("drawn", detail["drawn"])
        return cls(
            seed=checks.whole("seed", data["seed"], 0, checks.LARGEST_SEED),
            success=checks.truth("success", data["success"]),
            success_at_end=checks.truth("success_at_end", data.get("success_at_end", data["success"])),
            steps=checks.whole("steps", data["steps"], 0, LONGEST_EPISODE),
            ret=checks.number("return", data["return"]),
            phase_at_end=checks.text("phase_at_end", data.get("phase_at_end", ""), checks.LONGEST_NAME),
            detail=detail,
        )


@dataclass(frozen=True, slots=True)
class EvalSettings:
    """What two evaluations must share to be compared, and what running an episode again needs.

    horizon, success_steps: control steps. tolerance: distance to the goal that counts as there [m]. suite: the name of
    the conditions that episodes meet in turn. hold: control steps after success at which an episode ends, None where it
    goes on to the horizon.
    """

    horizon: int
    tolerance: float
    control_hz: int = _HZ
    success_steps: int = _STEPS
    suite: str = NOMINAL.name
    conditions: tuple[Condition, ...] = (NOMINAL,)
    hold: int | None = None

    @classmethod
    def of(cls, job: RolloutJob, suite: str = NOMINAL.name) -> EvalSettings:
        """Of the episodes of a job, whose conditions are called `suite`."""
        env, conditions = job.env, job.conditions or (NOMINAL,)
        return cls(env.horizon, env.tolerance, env.control_hz, env.success_steps, suite, conditions, job.hold)

    def env(self, robot: str, task: str) -> EnvConfig:
        """Return the environment that was evaluated in."""
        from manip_il.sim.env import EnvConfig  # here, as whoever only reads results needs no simulator

        return EnvConfig(robot, task, self.control_hz, self.tolerance, self.success_steps, self.horizon)

    @property
    def disturbance(self) -> str:
        """Conditions in words, `none` where there are no others than the nominal one."""
        return "; ".join(map(str, self.conditions)) if any(one.ranges for one in self.conditions) else "none"

    def __str__(self) -> str:
        rate = f"{self.control_hz} Hz, {self.success_steps} steps in a row"
        ends = "" if self.hold is None else f", ended {self.hold} steps after success"
        return f"horizon {self.horizon}, tolerance {self.tolerance} m, {rate}, suite {self.suite}{ends}"

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {
            "horizon": self.horizon,
            "tolerance": self.tolerance,
            "control_hz": self.control_hz,
            "success_steps": self.success_steps,
            "hold": self.hold,
            "suite": self.suite,
            "conditions": [condition.to_json() for condition in self.conditions],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EvalSettings:
        """Return the inverse of `to_json`; `ManipError` or `KeyError` where a value is amiss or missing."""
        data = checks.mapping("settings", data)
        given = checks.array("conditions", data.get("conditions", [NOMINAL.to_json()]), _MOST_CONDITIONS)
        named = [checks.mapping("a condition", one) for one in given]
        ranges = [{key: value for key, value in one.items() if key != "name"} for one in named]
        return cls(
            horizon=checks.whole("horizon", data["horizon"], 1, LONGEST_EPISODE),
            tolerance=checks.number("tolerance", data["tolerance"], 0, 1),
            control_hz=checks.whole("control_hz", data.get("control_hz", _HZ), 1, 1_000),
            success_steps=checks.whole("success_steps", data.get("success_steps", _STEPS), 1, LONGEST_EPISODE),
            suite=checks.text("suite", data.get("suite", NOMINAL.name)),
            conditions=tuple(Condition.from_mapping(one["name"], own) for one, own in zip(named, ranges, strict=True)),
            hold=None if data.get("hold") is None else checks.whole("hold", data["hold"], 0, LONGEST_EPISODE),
        )


@dataclass(frozen=True)
class EvalResult:
    """One policy on one robot and task: every episode, and what follows from them.

    policy_sha256: of its files, empty where it has none. until_width: the width of the interval at which the evaluation
    was to stop, None where the number of episodes was fixed before; intervals then hold at any stop.

    Raises `ManipError` on construction where there is no episode or a seed comes twice.
    """

    policy: str
    robot: str
    task: str
    fingerprint: Mapping[str, Any]
    episodes: tuple[EpisodeResult, ...]
    settings: EvalSettings
    confidence: float = CONFIDENCE
    policy_sha256: str = ""
    until_width: float | None = None

    def __post_init__(self) -> None:
        if not self.episodes:
            raise ManipError(f"evaluation of {self.policy}: no episodes")
        seeds = {episode.seed for episode in self.episodes}
        if len(seeds) != len(self.episodes):
            raise ManipError(
                f"evaluation of {self.policy}: {len(self.episodes)} episodes on {len(seeds)} seeds; "
                "every episode needs its own seed"
            )

    @property
    def success(self) -> Proportion:
        """Episodes that succeeded at some time."""
        return self._proportion([episode.success for episode in self.episodes])

    @property
    def success_at_end(self) -> Proportion:
        """Episodes that stood at the goal when they ended."""
        return self._proportion([episode.success_at_end for episode in self.episodes])

    @property
    def by_condition(self) -> dict[str, Proportion]:
        """Success under each condition that an episode met, in the settings' order; none where nothing says it."""
        met: dict[str, list[bool]] = {condition.name: [] for condition in self.settings.conditions}
        for episode in self.episodes:
            if "condition" in episode.detail:
                met.setdefault(str(episode.detail["condition"]), []).append(episode.success)
        return {name: self._proportion(outcomes) for name, outcomes in met.items() if outcomes}

    def _proportion(self, outcomes: Sequence[bool]) -> Proportion:
        return Proportion.of(outcomes, self.confidence, self.until_width is not None)

    @property
    def steps_to_success(self) -> float | None:
        """Mean over the episodes that succeeded, until they first did [control steps]; None where none tells."""
        steps = [episode.detail.get("steps_to_success") for episode in self.episodes if episode.success]
        known = [float(count) for count in steps if count is not None]
        return sum(known) / len(known) if known else None

    @property
    def failures(self) -> dict[str, int]:
        """Failed episodes by the phase they ended in, most frequent first."""
        phases = [episode.phase_at_end for episode in self.episodes if not episode.success]
        return dict(sorted(((p, phases.count(p)) for p in set(phases)), key=lambda item: (-item[1], item[0])))

    def to_json(self) -> dict[str, Any]:
        """Return the contract of `eval.json`."""
        return {
            "success_rate": self.success.rate,
            "interval": list(self.success.interval),
            "confidence": self.confidence,
            "interval_method": WILSON if self.until_width is None else ANYTIME,
            "n_episodes": len(self.episodes),
            "success_at_end_rate": self.success_at_end.rate,
            "until_width": self.until_width,
            "by_condition": {
                name: {"success_rate": one.rate, "interval": list(one.interval), "n_episodes": one.n}
                for name, one in self.by_condition.items()
            },
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
        """Return the inverse of `to_json`: rates and interval are worked out anew from the episodes."""
        width = data.get("until_width")
        return cls(
            policy=checks.text("policy", data["policy"]),
            robot=checks.name("robot", data["robot"]),
            task=checks.name("task", data["task"]),
            fingerprint=checks.mapping("fingerprint", data["fingerprint"]),
            episodes=tuple(EpisodeResult.from_json(one) for one in checks.array("episodes", data["episodes"])),
            settings=EvalSettings.from_json(data["settings"]),
            confidence=checks.number("confidence", data.get("confidence", CONFIDENCE), 0.5, 0.9999),
            policy_sha256=checks.text("policy_sha256", data.get("policy_sha256", "")),
            until_width=None if width is None else checks.number("until_width", width, 0, 1),
        )

    def write(self, path: Path) -> None:
        """Write `path` whole or not at all, creating its folder."""
        text = json.dumps(self.to_json(), indent=1, allow_nan=False, ensure_ascii=False)
        path.parent.mkdir(parents=True, exist_ok=True)
        write_file(path, (text + "\n").encode())

    @classmethod
    def read(cls, path: Path) -> EvalResult:
        """Read what `write` wrote; `ManipError` for a file that is missing, cut short or not of this kind.

        `path` may be the folder that holds `eval.json`.
        """
        path = path / FILE_NAME if path.is_dir() else path
        data = checks.read_json(path, f"an {FILE_NAME} of manip-il eval")
        try:
            result = cls.from_json(data)
        except KeyError as error:
            raise ManipError(f"{path}: key {error} is missing; expected an {FILE_NAME}") from error
        except MismatchError:
            raise
        except ManipError as error:
            raise ManipError(f"{path}: not an {FILE_NAME}: {error}") from error
        stated = data.get("n_episodes", len(result.episodes))
        if stated != len(result.episodes):
            said = checks.shorten(stated)
            raise MismatchError(f"{path}: number of episodes", "n_episodes", said, "episodes", len(result.episodes))
        return result


def compare_results(left: EvalResult, right: EvalResult, names: tuple[str, str] | None = None) -> PairedComparison:
    """Compare two evaluations on the seeds that both ran.

    Raises `MismatchError` where robot, task or settings differ, and `ManipError` where no seed is shared.
    """
    names = names or (left.policy, right.policy)
    for what in ("robot", "task", "settings"):
        ours, theirs = getattr(left, what), getattr(right, what)
        if ours != theirs:
            raise MismatchError(what, names[0], ours, names[1], theirs)
    ours = {episode.seed: episode.success for episode in left.episodes}
    theirs = {episode.seed: episode.success for episode in right.episodes}
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        raise ManipError(f"{names[0]} and {names[1]} share no seed; evaluate both with the same --seed=")
    return compare_paired([ours[seed] for seed in shared], [theirs[seed] for seed in shared], names, left.confidence)
