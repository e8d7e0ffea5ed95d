"""Evaluations with conditions and phases, made without running anything."""

from collections.abc import Callable, Sequence
from pathlib import Path

from manip_il.evaluation.comparison import Study
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.evaluation.side import Member, Rule, Side, history

from .test_rounds import records

FIRST_SEED = 4_000_000
CONDITIONS = ("nominal", "knocked", "sensing")
PHASES = ("descend", "descend", "carry", "grasp", "none")
Fails = Callable[[int], bool]


def often(number: int) -> bool:
    return number % 3 == 0


def seldom(number: int) -> bool:
    return number % 37 == 0


def made_eval(
    policy: str = "runs/a/best",
    n: int = 120,
    fails: Fails = often,
    conditions: tuple[str, ...] = CONDITIONS,
    phases: tuple[str, ...] = PHASES,
) -> EvalResult:
    """Episodes that fail where `fails` says, with conditions and phases in turn."""
    episodes: list[EpisodeResult] = []
    for number in range(n):
        good = not fails(number)
        phase = "at_goal" if good else phases[number // 3 % len(phases)]
        detail = {
            "condition": conditions[number % len(conditions)],
            "steps_to_success": 40 if good else None,
        }
        episodes.append(EpisodeResult(FIRST_SEED + number, good, good, 100, -20.0, phase, detail))
    fingerprint = {"mujoco": "3.11.0", "model_sha256": "ab" * 32}
    return EvalResult(
        policy, "panda", "pick_place", fingerprint, tuple(episodes), EvalSettings(100, 0.02)
    )


def made_pair(left: Fails, right: Fails, seeds: int = 1) -> Study:
    """Two runs; with several training seeds each seed's policy fails in the same episodes."""
    sides = (
        made_side("runs/cloning", [made_eval(fails=left)] * seeds, (0.3, 0.5, 0.6)),
        made_side("runs/dagger", [made_eval(fails=right)] * seeds, (0.5, 0.9)),
    )
    return Study(sides, "runs/cloning")


def made_side(
    name: str, results: Sequence[EvalResult], successes: tuple[float, ...], labels: int = 100
) -> Side:
    """A side of runs, one per result, whose rounds had these successes on validation."""
    run = history(records(successes, labels), name)
    chosen = Rule().select(run, name)
    members = (
        Member(Path(name) / f"seed_{i}", i, run, Path("p"), chosen, one)
        for i, one in enumerate(results)
    )
    return Side(name, tuple(members))
