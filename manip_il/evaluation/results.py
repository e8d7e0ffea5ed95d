"""`eval.json`: what one evaluation of one policy found, and how to read it back."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.statistics import CONFIDENCE, PairedComparison, Proportion, compare_paired

FILE_NAME = "eval.json"


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
        """The episode as `eval.json` holds it."""
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
        """The inverse of `to_json`; `KeyError`, `TypeError` or `ValueError` where a value is amiss."""
        known = ("seed", "success", "success_at_end", "steps", "return", "phase_at_end")
        return cls(
            seed=_whole(data["seed"]),
            success=_truth(data["success"]),
            success_at_end=_truth(data.get("success_at_end", data["success"])),
            steps=_whole(data["steps"]),
            ret=float(data["return"]),
            phase_at_end=str(data.get("phase_at_end", "")),
            detail={key: value for key, value in data.items() if key not in known},
        )


@dataclass(frozen=True, slots=True)
class EvalSettings:
    """What two evaluations must share to be compared.

    horizon: control steps. tolerance: distance to the goal that counts as there [m].
    disturbance: in words, `none` where the episode runs undisturbed.
    """

    horizon: int
    tolerance: float
    disturbance: str = "none"

    def to_json(self) -> dict[str, Any]:
        """As plain JSON values."""
        return {"horizon": self.horizon, "tolerance": self.tolerance, "disturbance": self.disturbance}


@dataclass(frozen=True)
class EvalResult:
    """One policy on one robot and task: every episode, and what follows from them.

    Raises `ManipError` on construction where there is no episode or a seed comes twice.
    """

    policy: str
    robot: str
    task: str
    fingerprint: Mapping[str, Any]
    episodes: tuple[EpisodeResult, ...]
    settings: EvalSettings
    confidence: float = CONFIDENCE

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
        return Proportion.of([episode.success for episode in self.episodes], self.confidence)

    @property
    def success_at_end(self) -> Proportion:
        """Episodes that stood at the goal when they ended."""
        return Proportion.of([episode.success_at_end for episode in self.episodes], self.confidence)

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
        """The contract of `eval.json`."""
        return {
            "success_rate": self.success.rate,
            "interval": list(self.success.interval),
            "confidence": self.confidence,
            "n_episodes": len(self.episodes),
            "success_at_end_rate": self.success_at_end.rate,
            "policy": self.policy,
            "robot": self.robot,
            "task": self.task,
            "fingerprint": dict(self.fingerprint),
            "settings": self.settings.to_json(),
            "episodes": [episode.to_json() for episode in self.episodes],
        }

    @classmethod
    def from_json(cls, data: Mapping[str, Any]) -> EvalResult:
        """The inverse of `to_json`: rates and interval are worked out anew from the episodes."""
        settings = data["settings"]
        return cls(
            policy=str(data["policy"]),
            robot=str(data["robot"]),
            task=str(data["task"]),
            fingerprint=dict(data["fingerprint"]),
            episodes=tuple(EpisodeResult.from_json(episode) for episode in data["episodes"]),
            settings=EvalSettings(
                horizon=_whole(settings["horizon"]),
                tolerance=float(settings["tolerance"]),
                disturbance=str(settings.get("disturbance", "none")),
            ),
            confidence=float(data.get("confidence", CONFIDENCE)),
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
        data = _read_object(path)
        try:
            result = cls.from_json(data)
        except KeyError as error:
            raise ManipError(f"{path}: key {error} is missing; expected an {FILE_NAME}") from error
        except (TypeError, ValueError, AttributeError) as error:
            raise ManipError(f"{path}: not an {FILE_NAME}: {error}") from error
        stated = data.get("n_episodes", len(result.episodes))
        if stated != len(result.episodes):
            raise MismatchError(f"{path}: number of episodes", "n_episodes", stated, "episodes", len(result.episodes))
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


def _read_object(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_bytes())
    except FileNotFoundError as error:
        raise ManipError(f"{path} does not exist; `manip-il eval` writes it") from error
    except OSError as error:
        raise ManipError(f"{path} cannot be read: {error.strerror}") from error
    except ValueError as error:  # broken JSON or broken UTF-8
        raise ManipError(f"{path} is not whole JSON: {error}") from error
    if not isinstance(data, dict):
        raise ManipError(f"{path} holds a {type(data).__name__}; expected the object of an {FILE_NAME}")
    return data


def _whole(value: object) -> int:
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{value!r} is not a whole number")
    return value


def _truth(value: object) -> bool:
    if not isinstance(value, bool):
        raise TypeError(f"{value!r} is neither true nor false")
    return value
