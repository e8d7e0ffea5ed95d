"""Evaluations with places, conditions and draws, made without running anything."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.evaluation.comparison import Study
from manip_il.evaluation.film import encode_mp4
from manip_il.evaluation.report import Film
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.rounds import Rule, history
from manip_il.evaluation.side import Member, Side

from .test_rounds import records

FIRST_SEED = 4_000_000
CONDITIONS = ("nominal", "knocked", "sensing")
PHASES = ("descend", "descend", "carry", "grasp", "none")
Fails = Callable[[int, dict[str, Any]], bool]


def far_corner(number: int, detail: dict[str, Any]) -> bool:
    """Fails where the object starts far to the left; elsewhere seldom."""
    x, y, _ = detail["start"]["object"]
    return (x > 0.5 and y > 0.05) or number % 37 == 0


def made_eval(
    policy: str = "runs/a/best",
    n: int = 120,
    fails: Fails = far_corner,
    conditions: tuple[str, ...] = CONDITIONS,
    phases: tuple[str, ...] = PHASES,
) -> EvalResult:
    """The same starts and draws whatever fails."""
    rng = np.random.default_rng(3)
    episodes: list[EpisodeResult] = []
    for number in range(n):
        detail = _detail(rng, conditions[number % len(conditions)])
        failed = fails(number, detail)
        detail["steps_to_success"] = None if failed else 40 + number % 7
        phase = phases[number % len(phases)] if failed else "at_goal"
        episodes.append(EpisodeResult(FIRST_SEED + number, not failed, not failed, 100, -20.0, phase, detail))
    fingerprint = {"mujoco": "3.11.0", "model_sha256": "ab" * 32}
    return EvalResult(policy, "panda", "pick_place", fingerprint, tuple(episodes), EvalSettings(100, 0.02))


def made_pair(left: Fails, right: Fails, seeds: int = 1) -> Study:
    """Two runs; with several training seeds each seed's policy fails in the same episodes."""
    sides = (
        made_side("runs/cloning", [made_eval(fails=left)] * seeds, (0.3, 0.5, 0.6)),
        made_side("runs/dagger", [made_eval(fails=right)] * seeds, (0.5, 0.9)),
    )
    return Study(sides, "runs/cloning")


def made_side(name: str, results: Sequence[EvalResult], successes: tuple[float, ...], labels: int = 100) -> Side:
    """A side of runs, one per result, whose rounds had these successes on validation."""
    run = history(records(successes, labels), name)
    chosen = Rule().select(run, name)
    members = (Member(Path(name) / f"seed_{i}", i, run, Path("p"), chosen, one) for i, one in enumerate(results))
    return Side(name, tuple(members))


def small_film(number: int) -> Film:
    """A second of a square that wanders."""
    frames = np.full((12, 48, 64, 3), 230, dtype=np.uint8)
    for index, frame in enumerate(frames):
        frame[10:30, 4 * index : 4 * index + 14] = (200, 40 * number % 255, 60)
    return Film("policy", encode_mp4(list(frames), 12), f"seed {FIRST_SEED + number}")


def _detail(rng: np.random.Generator, condition: str) -> dict[str, Any]:
    x, y, a = (float(value) for value in rng.uniform(-1, 1, 3))
    drawn: dict[str, Any] = {}
    if condition == "knocked":
        drawn = {"action_noise": 0.1, "knock": 0.05 + 0.03 * abs(a), "knock_step": int(rng.integers(5, 25))}
    if condition == "sensing":
        drawn = {"delay": int(rng.integers(0, 4)), "colour": [float(value) for value in rng.uniform(size=3)]}
    return {
        "condition": condition,
        "drawn": drawn,
        "start": {"hand": [0.4, 0.0, 0.3], "object": [0.45 + 0.15 * x, 0.15 * y, 0.025]},
    }
