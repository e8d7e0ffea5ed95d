"""`eval.json`: one evaluation of one policy, reading it back, merging parts of it and comparing two."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.atomic import write_file
from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.episodes import EpisodeResult, EvalSettings
from manip_il.evaluation.intervals import CONFIDENCE, Proportion
from manip_il.evaluation.significance import PairedComparison, compare_paired

FILE_NAME = "eval.json"
WILSON = "Wilson's score interval"
ANYTIME = "confidence sequence: holds whenever one stops"
_EQUAL_IN_PARTS = ("policy_sha256", "robot", "task", "settings")


@dataclass(frozen=True)
class EvalResult:
    """One policy on one robot and task: every episode, and what follows from them.

    policy_sha256: of its files, empty where it has none. until_width: the width of the interval at which the evaluation
    was to stop, None where the number of episodes was fixed in advance; intervals then hold at any stop.

    Raises `ManipError` on construction where there is no episode or a seed comes twice.
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

    def _proportion(self, outcomes: Sequence[bool]) -> Proportion:
        return Proportion.of(outcomes, self.until_width is not None)

    @cached_property
    def by_condition(self) -> dict[str, EvalResult]:
        """Each condition's episodes, in the settings' order; under an empty name those without a condition."""
        parts: dict[str, list[EpisodeResult]] = {condition.name: [] for condition in self.settings.conditions}
        for episode in self.episodes:
            parts.setdefault(episode.condition, []).append(episode)
        return {name: replace(self, episodes=tuple(episodes)) for name, episodes in parts.items() if episodes}

    @property
    def steps_to_success(self) -> float | None:
        """Mean over the episodes that succeeded, until they first did [control steps]; None where none records it."""
        steps = [episode.detail.get("steps_to_success") for episode in self.episodes if episode.success]
        known = [float(count) for count in steps if count is not None]
        return sum(known) / len(known) if known else None

    @property
    def failures(self) -> dict[str, int]:
        """Failed episodes by the phase they ended in, most frequent first."""
        phases = [episode.phase_at_end for episode in self.episodes if not episode.success]
        return dict(sorted(((p, phases.count(p)) for p in set(phases)), key=lambda item: (-item[1], item[0])))

    def to_json(self) -> dict[str, Any]:
        """Return the contents of `eval.json`."""
        return {
            "success_rate": self.success.rate,
            "interval": list(self.success.interval),
            "confidence": CONFIDENCE,
            "interval_method": WILSON if self.until_width is None else ANYTIME,
            "n_episodes": len(self.episodes),
            "success_at_end_rate": self.success_at_end.rate,
            "until_width": self.until_width,
            "by_condition": {
                name: {"success_rate": part.rate, "interval": list(part.interval), "n_episodes": part.n}
                for name, part in ((name, part.success) for name, part in self.by_condition.items() if name)
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
        """Return the inverse of `to_json`: rates and intervals are computed anew from the episodes.

        Raises `KeyError`, `TypeError` or `ValueError` if a value is missing or of another kind.
        """
        return cls(
            policy=data["policy"],
            # names, not paths: a task's path would be code to run
            robot=checks.name("robot", data["robot"]),
            task=checks.name("task", data["task"]),
            fingerprint=data["fingerprint"],
            episodes=tuple(map(EpisodeResult.from_json, data["episodes"])),
            settings=EvalSettings.from_json(data["settings"]),
            policy_sha256=data.get("policy_sha256", ""),
            until_width=data.get("until_width"),
        )

    def write(self, path: Path) -> None:
        """Write `path` whole or not at all, creating its folder."""
        write_json(path, self.to_json())

    @classmethod
    def read(cls, path: Path) -> EvalResult:
        """Read what `write` wrote; `ManipError` for a file that is missing, cut short or not of this kind.

        `path` may be the folder that holds `eval.json`.
        """
        path = path / FILE_NAME if path.is_dir() else path
        data = checks.read_json(path, f"an {FILE_NAME} of manip-il eval")
        try:
            result = cls.from_json(data)
            stated = int(data.get("n_episodes", len(result.episodes)))
        except (KeyError, TypeError, ValueError, ArithmeticError, AttributeError, ManipError) as error:
            why = f"key {error} is missing" if isinstance(error, KeyError) else checks.one_line(error)
            raise ManipError(f"{path}: not an {FILE_NAME}: {why}") from error
        if stated != len(result.episodes):
            raise MismatchError(f"{path}: number of episodes", "n_episodes", stated, "episodes", len(result.episodes))
        return result


def compare_results(left: EvalResult, right: EvalResult, names: tuple[str, str] | None = None) -> PairedComparison:
    """Compare two evaluations on the seeds that both ran.

    Raises `MismatchError` where robot, task or settings differ, and `ManipError` where no seed is shared.
    """
    names = names or (left.policy, right.policy)
    _require_equal(("robot", "task", "settings"), names[0], left, names[1], right)
    ours = {episode.seed: episode.success for episode in left.episodes}
    theirs = {episode.seed: episode.success for episode in right.episodes}
    shared = sorted(ours.keys() & theirs.keys())
    if not shared:
        raise ManipError(f"{names[0]} and {names[1]} share no seed; evaluate both with the same --seed=")
    return compare_paired([ours[seed] for seed in shared], [theirs[seed] for seed in shared], names)


def merge_results(parts: Mapping[str, EvalResult]) -> EvalResult:
    """Return all episodes of the parts (name -> part), in the order of their seeds.

    Raises `MismatchError` where they are not of one policy in one world, and `ManipError` for no part, for a seed that
    two of them ran, or for a part whose number of episodes depended on its outcomes.
    """
    if not parts:
        raise ManipError("no evaluations to merge; expected at least one")
    (first, one), *others = parts.items()
    for name, other in others:
        known = one.policy_sha256 or other.policy_sha256  # else the names alone say whether the policy is the same
        _require_equal(_EQUAL_IN_PARTS if known else ("policy", *_EQUAL_IN_PARTS), first, one, name, other)
    found: dict[int, tuple[str, EpisodeResult]] = {}
    for name, part in parts.items():
        if part.until_width is not None:
            raise ManipError(f"{name} stopped by --until_width; only parts with a fixed number of episodes merge")
        for episode in part.episodes:
            if episode.seed in found:
                raise ManipError(
                    f"seed {episode.seed} is in {found[episode.seed][0]} and in {name}; give every part seeds of its "
                    "own, by --eval.first= and --eval.n_episodes="
                )
            found[episode.seed] = name, episode
    return replace(one, episodes=tuple(episode for _, (_, episode) in sorted(found.items())))


def write_json(path: Path, content: Mapping[str, Any], indent: int | None = 1) -> None:
    """Write `content` whole or not at all, creating the folder."""
    path.parent.mkdir(parents=True, exist_ok=True)
    write_file(path, (json.dumps(content, indent=indent, allow_nan=False, ensure_ascii=False) + "\n").encode())


def _require_equal(names: Sequence[str], left: str, one: EvalResult, right: str, other: EvalResult) -> None:
    """Raise `MismatchError` naming the first field, of the settings too, in which two evaluations differ."""
    plain = [name for name in names if name != "settings"]
    sides = [(name, getattr(one, name), getattr(other, name)) for name in plain]
    if "settings" in names:
        own = [field.name for field in fields(EvalSettings)]
        sides += [(name, getattr(one.settings, name), getattr(other.settings, name)) for name in own]
    for name, ours, theirs in sides:
        if ours != theirs:
            words = ("; ".join(map(str, side)) if isinstance(side, tuple) else side for side in (ours, theirs))
            raise MismatchError(name, left, next(words), right, next(words))
