"""Which round a comparison takes follows from the rule and the validation alone."""

from typing import Any

from manip_il.evaluation.side import Rule, history

SUCCESS = (0.5, 0.9, 0.8, 0.9, 0.7)


def records(
    successes: tuple[float, ...] = SUCCESS, labels: int = 100, seconds: float = 10.0
) -> list[dict[str, Any]]:
    return [
        {
            "round": i,
            "labels": labels * (i + 1),
            "steps": labels * (i + 1),
            "episodes": 3 * (i + 1),
            "validation_success": success,
            "validation_episodes": 10,
            "seconds": {
                "collect": seconds / 4,
                "fit": seconds / 2,
                "redraw": seconds / 4,
                "validate": 100.0,
            },
        }
        for i, success in enumerate(successes)
    ]


RUN = history(records(), "runs/x")


def test_validated_iterations_are_rounds_and_cost_what_all_before_them_took():
    lines = [
        {
            "iteration": i,
            "steps": 100 * i,
            "episodes": 2 * i,
            "validation_success": rate,
            "validation_episodes": 10,
        }
        | {"seconds": {"collect": 1.0, "fit": 2.0, "validate": 4.0}}
        for i, rate in enumerate((0.2, None, 0.5))
    ]
    found = [
        (one.unit, one.round, one.steps, one.labels, one.seconds) for one in history(lines, "x")
    ]
    assert found == [("iteration", 0, 0, 0, 3.0), ("iteration", 2, 200, 0, 9.0)]


def test_best_is_the_later_of_equals_and_last_is_last():
    assert Rule("best").select(RUN, "x").round == 3
    assert Rule("last").select(RUN, "x").round == 4


def test_rounds_count_up_to_what_every_run_reached():
    shorter = history(records((0.1, 0.2, 0.3), labels=120, seconds=40), "y")
    both = {"x": RUN, "y": shorter}
    rules = {at: Rule("last", at).limited(both) for at in ("end", "labels", "episodes", "seconds")}
    limits = {at: rule.limit for at, rule in rules.items()}
    assert limits == {"end": None, "labels": 360, "episodes": 9, "seconds": 50}
    assert [rules["seconds"].select(run, "x").round for run in (RUN, shorter)] == [4, 0]
    assert [rules["labels"].select(run, "x").round for run in (RUN, shorter)] == [2, 2]
