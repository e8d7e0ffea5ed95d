"""Conditions: ranges that refuse themselves, and draws that belong to their seed and their name."""

from __future__ import annotations

import json

import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.sim.conditions import NOMINAL, Condition, draw
from manip_il.sim.config import CAMERAS
from manip_il.sim.shape import KINDS

KNOCKED = Condition("knocked", knock=(0.05, 0.08), knock_step=(5, 9), action_noise=(0.1, 0.1))
OBJECT = Condition("object", mass=(0.05, 0.3), size=(0.04, 0.06), colour=(0.1, 0.9))
VIEW = Condition(
    "view", camera_shift=(0.01, 0.05), camera_turn=(0, 5), brightness=(0.6, 1.4), light_turn=(-60, 60), table=(0.2, 0.9)
)


def test_a_seed_draws_the_same_in_whatever_order():
    drawn = [draw([KNOCKED, VIEW], seed) for seed in range(20)]
    assert [draw([KNOCKED, VIEW], seed) for seed in range(19, -1, -1)] == drawn[::-1]
    assert len({json.dumps(dict(one.values)) for one in drawn}) == 20


def test_conditions_take_turns_by_seed():
    turns = [draw([NOMINAL, KNOCKED, VIEW], seed).condition for seed in range(3, 8)]
    assert turns == ["nominal", "knocked", "view", "nominal", "knocked"]
    assert draw([], 4) == draw([NOMINAL], 4)


def test_every_draw_is_within_its_range_and_reaches_both_ends():
    drawn = [draw([KNOCKED], seed).values for seed in range(300)]
    assert {one["knock_step"] for one in drawn} == {5, 6, 7, 8, 9}
    knocks = [one["knock"] for one in drawn]
    assert min(knocks) >= 0.05
    assert max(knocks) <= 0.08
    assert max(knocks) - min(knocks) > 0.028
    assert {one["action_noise"] for one in drawn} == {0.1}


def test_another_range_leaves_the_other_draws_as_they_were():
    wider = Condition("object", mass=(0.01, 3), size=(0.04, 0.06), colour=(0.1, 0.9), friction=(0.5, 1.0))
    for seed in range(5):
        one, other = draw([OBJECT], seed).values, draw([wider], seed).values
        assert one["mass"] != other["mass"]
        assert (one["size"], one["colour"]) == (other["size"], other["colour"])


def test_a_draw_is_plain_json():
    for condition in (KNOCKED, OBJECT, VIEW):
        drawn = dict(draw([condition], 3).values)
        assert json.loads(json.dumps(drawn)) == drawn


def test_a_camera_moves_by_a_drawn_length_in_any_direction():
    shifts = np.array([draw([VIEW], seed).values["camera_shift"]["front"] for seed in range(200)])
    lengths = np.linalg.norm(shifts, axis=1)
    assert lengths.min() >= 0.01 - 1e-12
    assert lengths.max() <= 0.05 + 1e-12
    assert (np.abs((shifts > 0).mean(axis=0) - 0.5) < 0.15).all()
    assert set(draw([VIEW], 0).values["camera_shift"]) == set(CAMERAS)


def test_only_what_is_physics_changes_the_model():
    assert OBJECT.changes_model()
    assert Condition("soft", actuator_gain=(0.7, 1.3)).changes_model()
    assert not VIEW.changes_model()
    assert not Condition("elsewhere", posture=(0.1, 0.1)).changes_model()


def test_what_nobody_notices_is_left_out():
    assert VIEW.for_world(has_object=True, sees=False, sizes=(0.03, 0.07)) is None
    assert OBJECT.for_world(has_object=False, sees=True, sizes=(0.03, 0.07)) is None
    assert OBJECT.for_world(has_object=True, sees=False, sizes=(0.03, 0.07)).ranges == {
        "mass": (0.05, 0.3),
        "size": (0.04, 0.06),
    }
    assert KNOCKED.for_world(has_object=False, sees=False, sizes=(0.03, 0.07)).ranges == {"action_noise": (0.1, 0.1)}
    assert NOMINAL.for_world(has_object=False, sees=False, sizes=(0.03, 0.07)) == NOMINAL
    assert VIEW.for_world(has_object=False, sees=True, sizes=(0.03, 0.07)) == VIEW


ROUND = Condition("round", shape=("sphere", "cylinder"), size=(0.02, 0.06))


def test_an_object_of_any_shape_has_one_of_the_conditions_shapes_or_of_all():
    for conditions, shapes in (([ROUND], ROUND.ranges["shape"]), ([OBJECT], KINDS), ([], KINDS)):
        assert {draw(conditions, seed, "any").values["shape"] for seed in range(40)} == set(shapes)
    assert draw([OBJECT], 3, "any").values.items() >= draw([OBJECT], 3).values.items()
    assert "shape" not in draw([ROUND], 3, "sphere:0.04").values
    assert "shape" not in ROUND.for_world(has_object=True, sees=True, sizes=(0.02, 0.07)).ranges
    assert ROUND.for_world(has_object=True, sees=True, sizes=(0.02, 0.07), shape="any:0.05") == ROUND
    assert str(ROUND) == "round (shape sphere or cylinder, size 0.02 to 0.06)"


def test_sizes_are_those_that_a_task_can_take():
    assert OBJECT.for_world(has_object=True, sees=False, sizes=(0.05, 0.08)).ranges["size"] == (0.05, 0.06)
    assert "size" not in OBJECT.for_world(has_object=True, sees=True, sizes=None).ranges
    with pytest.raises(UsageError, match=r"size is 0[.]04 to 0[.]06 m, and the task takes objects of 0[.]01 to"):
        OBJECT.for_world(has_object=True, sees=True, sizes=(0.01, 0.03))


def test_a_condition_is_its_json_again():
    for condition in (NOMINAL, KNOCKED, OBJECT, VIEW, ROUND):
        tree = json.loads(json.dumps(condition.to_json()))
        assert Condition.from_mapping(tree.pop("name"), tree) == condition


@pytest.mark.parametrize(
    ("tree", "words"),
    [
        ({"mass": [0.3, 0.1]}, "expected low <= high"),
        ({"shape": "ball"}, "unknown shape in mine: 'ball'"),
        ({"shape": ["box", "box"]}, "expected names, each once"),
        ({"shape": []}, "expected names, each once"),
        ({"shape": [[1]]}, "unknown shape in mine:"),
        ({"frictoin": 1}, "did you mean 'friction'"),
        ({"mass": 0}, "within 0.001 to 10"),
        ({"mass": float("nan")}, "mass is"),
        ({"mass": [0.1, 0.2, 0.3]}, "expected a number, or [low, high]"),
        ({"mass": "heavy"}, "expected a number, or [low, high]"),
        ({"mass": True}, "expected a number, or [low, high]"),
        ({"delay": [0, 1.5]}, "expected whole numbers"),
        ({"action_noise": -0.1}, "action_noise is [-0.1, -0.1]; expected low <= high within 0 to 1"),
        ({"action_noise": [0.1, 1.5]}, "action_noise is [0.1, 1.5]; expected low <= high within 0 to 1"),
    ],
)
def test_a_range_that_cannot_be_is_one_line(tree, words):
    with pytest.raises(UsageError) as error:
        Condition.from_mapping("mine", tree)
    assert words in str(error.value)
    assert "mine" in str(error.value)
