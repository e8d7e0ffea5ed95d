"""The ladder of predicates on hands and objects placed by hand."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import ManipError
from manip_il.expert.skills import (
    AT_GRASP_ANGLE,
    CLEAR,
    CUBE_WIDTH,
    HOVER,
    LOWEST_EE,
    MAX_TILT,
    OPEN_SLACK,
    Geometry,
    angle_between,
    choose,
    grasp_yaw,
    hand_down,
    object_in_hand,
)
from manip_il.mdp import Phase

OPEN, CUBE_AT = 0.08, np.array([0.5, 0.1, 0.025])
GOAL = np.array([0.4, -0.1, 0.2])


def at(x: float, y: float, z: float, **changes) -> Geometry:
    """The hand, pointing down, by this much off an object that rests on the table; wide open."""
    plain = Geometry(CUBE_AT + [x, y, z], hand_down(0.0), OPEN, GOAL, OPEN, CUBE_WIDTH, CUBE_AT)
    return replace(plain, **changes)


def held(to_goal: tuple[float, float, float], opening: float = CUBE_WIDTH) -> Geometry:
    """The object in the hand, and the goal that far from it."""
    cube = np.array([0.5, 0.1, 0.15])
    return Geometry(cube, hand_down(0.0), opening, cube + to_goal, OPEN, CUBE_WIDTH, cube)


def test_far_from_the_object_the_hand_goes_over_it_with_open_fingers():
    target = choose(at(-0.2, 0.1, 0.2))
    assert (target.phase, target.opening) == (Phase.APPROACH, OPEN)
    np.testing.assert_allclose(target.position, CUBE_AT + [0, 0, HOVER])


def test_over_the_object_the_hand_descends_all_the_way():
    target = choose(at(0, 0, 0.08))
    assert (target.phase, target.opening) == (Phase.DESCEND, OPEN)
    np.testing.assert_allclose(target.position, CUBE_AT)


@given(st.floats(0, 0.2), st.floats(0, 0.2))
def test_the_nearer_to_being_over_the_object_the_lower_the_hand_may_go(one: float, other: float):
    near, far = sorted((one, other))
    heights = [choose(at(off, 0, 0.3)).position[2] for off in (near, far)]
    assert CUBE_AT[2] <= heights[0] <= heights[1] <= CUBE_AT[2] + HOVER


@given(st.floats(0.06, 0.2), st.floats(0, 2 * np.pi), st.floats(-0.02, 0.04))
def test_beside_the_object_a_hand_that_is_too_low_only_rises(off: float, direction: float, height: float):
    g = at(off * np.cos(direction), off * np.sin(direction), height)
    target = choose(g)
    np.testing.assert_array_equal(target.position[:2], g.ee[:2])
    assert target.position[2] > g.ee[2] + 0.03


def test_around_the_object_the_fingers_close():
    target = choose(at(0.003, -0.003, 0.004))
    assert (target.phase, target.opening) == (Phase.GRASP, 0.0)
    np.testing.assert_allclose(target.position, CUBE_AT)


def test_closing_goes_on_once_it_has_begun():
    beside = 0.018  # too far to begin with
    half = CUBE_WIDTH + 0.75 * OPEN_SLACK
    assert choose(at(beside, 0, 0)).phase != Phase.GRASP
    assert choose(at(beside, 0, 0, opening=half)).phase == Phase.GRASP


@pytest.mark.parametrize("opening", [0.0, 0.03, CUBE_WIDTH + OPEN_SLACK / 2])
def test_fingers_that_closed_too_early_open_before_the_hand_descends(opening: float):
    target = choose(at(0, 0, 0.09, opening=opening))
    assert (target.phase, target.opening) == (Phase.OPEN, OPEN)
    assert target.position[2] >= CUBE_AT[2] + CLEAR


def test_closed_fingers_on_the_cube_hold_it_and_empty_ones_do_not():
    assert choose(at(0, 0, 0, opening=CUBE_WIDTH)).phase == Phase.CARRY
    assert choose(at(0, 0, 0, opening=0.0)).phase != Phase.CARRY
    assert choose(at(0.06, 0, 0, opening=CUBE_WIDTH)).phase != Phase.CARRY


def test_a_turned_hand_does_not_close():
    turned = at(0, 0, 0, ee_rotation=hand_down(AT_GRASP_ANGLE + 0.1))
    assert choose(turned).phase == Phase.DESCEND
    np.testing.assert_allclose(choose(turned).rotation, hand_down(0.0))


def test_over_an_object_that_has_not_settled_the_hand_waits():
    tilted = at(0, 0, 0.1, object_tilt=MAX_TILT + 0.1)
    assert choose(tilted).position[2] >= CUBE_AT[2] + CLEAR
    assert choose(at(0, 0, 0, object_tilt=MAX_TILT + 0.1)).phase != Phase.GRASP


def test_a_held_object_goes_over_the_goal_first_and_then_down():
    far, near = choose(held((-0.2, 0.1, 0.0))), choose(held((-0.01, 0.0, -0.05)))
    assert far.phase == near.phase == Phase.CARRY
    assert far.opening == near.opening == 0.0
    np.testing.assert_allclose(far.position, held((0, 0, 0)).ee + [-0.2, 0.1, 0.05])
    np.testing.assert_allclose(near.position, held((0, 0, 0)).ee + [-0.01, 0, -0.05])


def test_at_the_goal_the_fingers_stay_closed():
    target = choose(held((0.004, 0, -0.004)))
    assert (target.phase, target.opening) == (Phase.AT_GOAL, 0.0)


def test_an_object_off_the_hands_middle_is_carried_by_its_own_centre():
    g = held((0.0, 0.0, 0.1))
    g = replace(g, ee=g.ee + [0.01, 0.005, 0.0])
    np.testing.assert_allclose(choose(g).position - g.ee, [0, 0, 0.1])


def test_without_an_object_the_hand_goes_to_the_goal():
    g = Geometry(CUBE_AT, hand_down(0.3), OPEN, GOAL, OPEN, CUBE_WIDTH)
    assert choose(g).phase == Phase.CARRY
    np.testing.assert_array_equal(choose(g).position, GOAL)
    assert choose(replace(g, ee=GOAL + 0.005)).phase == Phase.AT_GOAL
    with pytest.raises(ManipError, match="needs an object"):
        object_in_hand(g)


@given(st.floats(0, 0.2), st.floats(0, 2 * np.pi), st.floats(-0.02, 0.3), st.floats(0, OPEN))
def test_no_target_is_in_the_table(off: float, direction: float, height: float, opening: float):
    target = choose(at(off * np.cos(direction), off * np.sin(direction), height, opening=opening))
    assert target.position[2] >= LOWEST_EE


@given(st.floats(-np.pi / 4, np.pi / 4), st.floats(-np.pi, np.pi))
def test_a_grasp_is_one_of_the_cubes_own_and_no_far_turn(object_yaw: float, hand_yaw: float):
    yaw = grasp_yaw(at(0, 0, 0.1, object_yaw=object_yaw, ee_rotation=hand_down(hand_yaw)))
    assert np.exp(4j * yaw) == pytest.approx(np.exp(4j * object_yaw), abs=1e-9)
    assert abs(yaw) <= 3 * np.pi / 4


@given(st.floats(-np.pi, np.pi), st.floats(-np.pi, np.pi))
def test_the_angle_between_two_hands_is_the_difference_of_their_yaws(a: float, b: float):
    difference = abs((a - b + np.pi) % (2 * np.pi) - np.pi)
    assert angle_between(hand_down(a), hand_down(b)) == pytest.approx(difference, abs=1e-6)


@given(st.floats(-np.pi, np.pi))
def test_a_hand_that_points_down_is_a_rotation_whose_z_is_down(yaw: float):
    rotation = hand_down(yaw)
    np.testing.assert_allclose(rotation @ rotation.T, np.eye(3), atol=1e-12)
    assert np.linalg.det(rotation) == pytest.approx(1)
    np.testing.assert_array_equal(rotation[:, 2], [0, 0, -1])
