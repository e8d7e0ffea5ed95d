"""Conditions: ranges that refuse themselves, and draws that belong to their seed and their name."""

import json

import pytest

from manip_il.errors import UsageError
from manip_il.sim.conditions import NOMINAL, Condition, draw, turn_of
from manip_il.sim.shape import KINDS

KNOCKED = Condition("knocked", knock=(0.05, 0.08), knock_step=(5, 9), action_noise=(0.1, 0.1))
OBJECT = Condition("object", mass=(0.05, 0.3), size=(0.04, 0.06), colour=(0.1, 0.9))
VIEW = Condition(
    "view",
    camera_shift=(0.01, 0.05),
    camera_turn=(0, 5),
    brightness=(0.6, 1.4),
    light_turn=(-60, 60),
    table=(0.2, 0.9),
)


def test_a_seed_draws_the_same_in_whatever_order():
    drawn = [draw([KNOCKED, VIEW], seed) for seed in range(20)]
    assert [draw([KNOCKED, VIEW], seed) for seed in range(19, -1, -1)] == drawn[::-1]
    assert len({json.dumps(one) for one in drawn}) == 20


def test_conditions_take_turns_by_seed():
    turns = [turn_of([NOMINAL, KNOCKED, VIEW], seed).name for seed in range(3, 8)]
    assert turns == ["nominal", "knocked", "view", "nominal", "knocked"]
    assert turn_of([], 4) == NOMINAL


def test_every_draw_is_within_its_range_and_reaches_both_ends():
    drawn = [draw([KNOCKED], seed) for seed in range(300)]
    assert {one["knock_step"] for one in drawn} == {5, 6, 7, 8, 9}
    knocks = [one["knock"] for one in drawn]
    assert min(knocks) >= 0.05
    assert max(knocks) <= 0.08
    assert max(knocks) - min(knocks) > 0.028
    assert {one["action_noise"] for one in drawn} == {0.1}


def test_what_nobody_notices_is_left_out():
    assert VIEW.for_world(has_object=True, sees=False, sizes=(0.03, 0.07)) is None
    assert OBJECT.for_world(has_object=False, sees=True, sizes=(0.03, 0.07)) is None
    assert OBJECT.for_world(has_object=True, sees=False, sizes=(0.03, 0.07)).ranges == {
        "mass": (0.05, 0.3),
        "size": (0.04, 0.06),
    }
    assert KNOCKED.for_world(has_object=False, sees=False, sizes=(0.03, 0.07)).ranges == {
        "action_noise": (0.1, 0.1)
    }
    assert NOMINAL.for_world(has_object=False, sees=False, sizes=(0.03, 0.07)) == NOMINAL
    assert VIEW.for_world(has_object=False, sees=True, sizes=(0.03, 0.07)) == VIEW


def test_an_object_of_any_shape_has_one_of_all_shapes():
    for conditions in ([OBJECT], []):
        assert {draw(conditions, seed, "any")["shape"] for seed in range(40)} == set(KINDS)
    assert draw([OBJECT], 3, "any:0.04").items() >= draw([OBJECT], 3).items()
    assert "shape" not in draw([OBJECT], 3, "sphere:0.04")


def test_sizes_are_those_that_a_task_can_take():
    assert OBJECT.for_world(has_object=True, sees=False, sizes=(0.05, 0.08)).ranges["size"] == (
        0.05,
        0.06,
    )
    assert "size" not in OBJECT.for_world(has_object=True, sees=True, sizes=None).ranges
    with pytest.raises(
        UsageError, match=r"size is 0[.]04 to 0[.]06 m, and the task takes objects of 0[.]01 to"
    ):
        OBJECT.for_world(has_object=True, sees=True, sizes=(0.01, 0.03))


def test_a_condition_is_its_json_again():
    for condition in (NOMINAL, KNOCKED, OBJECT, VIEW):
        assert Condition(**json.loads(json.dumps(condition.to_json()))) == condition
