"""A verdict on few episodes says that no difference is shown."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

from manip_il.cli.dagger import best_verdict
from manip_il.cli.quickstart import quickstart_verdict
from manip_il.evaluation.report_data import PolicyRow
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings

NAMES = ["cloning (round 0)", "DAgger, round 1"]


def result(successes: int, n: int) -> EvalResult:
    episodes = tuple(EpisodeResult(seed, seed < successes, seed < successes, 5, 0.0) for seed in range(n))
    return EvalResult("p", "panda", "reach", {}, episodes, EvalSettings(100, 0.02))


def rounds(*successes: int, n: int) -> list[Any]:
    return [SimpleNamespace(round=index, validation=result(count, n)) for index, count in enumerate(successes)]


def test_the_best_round_of_few_episodes_is_taken_and_not_shown_to_be_better():
    said = best_verdict(NAMES, rounds(0, 0, n=4))
    assert said.startswith("DAgger, round 1 is chosen of 2, with 0.0 %")
    assert said.endswith("on 4 validation episodes; no difference from cloning (round 0) is shown.")
    assert "no difference from DAgger, round 1 is shown" in best_verdict(NAMES, rounds(2, 1, n=4))
    assert "no difference" in best_verdict(NAMES, rounds(0, 2, n=4))


def test_the_best_round_of_many_episodes_is_the_best():
    assert best_verdict(NAMES, rounds(50, 90, n=100)).startswith("DAgger, round 1 is the best of 2: 90.0 %")
    assert best_verdict(NAMES, rounds(3, n=4)).startswith("cloning (round 0): 75.0 %")


def test_the_quickstart_says_where_nothing_is_shown():
    rows = [PolicyRow.of(name, result(1, 4)) for name in ("expert", "cloned", "more", "dagger")]
    assert quickstart_verdict(rows, significant=False).endswith(
        "no difference between DAgger and cloning with as many labels."
    )
    assert quickstart_verdict(rows, significant=True).endswith("with the first demonstrations alone.")
