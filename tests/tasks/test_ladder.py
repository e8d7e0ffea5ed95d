"""The ladder of predicates on hands and objects placed by hand."""

from __future__ import annotations

import itertools
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any, ClassVar

import mujoco
import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from manip_il.robots.geometry import angle_ahead, angle_from_down, hand_down, rotation_matrix
from manip_il.robots.reach import Reach
from manip_il.sim.task import Rung, Target
from manip_il.sim.world import Pose
from manip_il.tasks.grasp import HOVER, LEAN, MAX_TILT, OPEN_SLACK, grasp_of, lie_of
from manip_il.tasks.ladder import CLEAR, pick_rungs

OPEN, EDGE = 0.08, 0.05  # of the hand; of the cube where a test says no other [m]
LOWEST = 0.021  # of the hand over the table [m]
EDGES = (0.03, 0.05, 0.07)
RUNGS = pick_rungs("object")
# the hand gets everywhere pointing down
UPRIGHT = Reach(np.array([-1.0, -1.0, -1.0]), np.zeros((41, 41, 41)))
LEANING = Reach(UPRIGHT.origin, np.ones((41, 41, 41)))  # nowhere
widths = st.floats(0.03, 0.07)
steepest = 60.0  # change of a target per change of where the hand is


@dataclass(frozen=True)
class Placed:
    """A world in which hand, cube and goal stand where a test puts them. edge: of the cube [m]."""

    ee: Pose
    cube: Pose
    goal: np.ndarray
    opening: float = OPEN
    edge: float = EDGE
    touching: bool = False
    around: tuple[tuple[float, float], ...] = ()
    reach: Reach = UPRIGHT
    resting: bool = False
    gripper: ClassVar[Any] = SimpleNamespace(most=OPEN, lopsided=False, middle=lambda opening: 0.0)
    robot: ClassVar[Any] = SimpleNamespace(ee=SimpleNamespace(lowest=LOWEST), leans=False)

    @property
    def hand_yaw(self):
        return angle_ahead(self.ee.rotation)

    def ahead(self, position):
        return 0.0

    def off_down(self, yaw):
        return angle_from_down(self.ee.rotation, yaw)

    def pose(self, name):
        return {"object": self.cube}[name]

    def at(self, name):
        return self.pose(name).position

    def extents(self, name):
        return (self.edge,) * 3

    def hull(self, name):
        return None

    def kind(self, name):
        return int(mujoco.mjtGeom.mjGEOM_BOX)

    def neighbours(self, name):
        return self.around

    def touched(self, name):
        return self.touching

    def at_rest(self, name):
        return self.resting

    def remember(self, key, work_out):
        return work_out()

    def moved(self, x, y, z):
        return replace(self, ee=Pose(self.ee.position + [x, y, z], self.ee.rotation))


def about(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    return rotation_matrix(angle * np.array(axis, float))


def at(
    x: float,
    y: float,
    z: float,
    yaw: float = 0.0,
    tilt: float = 0.0,
    edge: float = EDGE,
    **changes: Any,
) -> Placed:
    """The hand, pointing down and turned by `yaw`, by this much off a cube that rests on the table.

    Wide open.
    """
    cube = np.array([0.5, 0.1, edge / 2])
    hand = Pose(cube + [x, y, z], hand_down(yaw))
    return Placed(
        hand, Pose(cube, about((1, 0, 0), tilt)), np.array([0.4, -0.1, 0.2]), edge=edge, **changes
    )


def turned(rotation: np.ndarray, **changes: Any) -> Placed:
    """The cube turned, and the hand over it."""
    world = at(0, 0, 0.1, **changes)
    return replace(world, cube=Pose(world.cube.position, rotation))


@pytest.mark.parametrize(
    ("reach", "lean", "phase"), [(UPRIGHT, 0.0, "descend"), (LEANING, 1.0, "grasp")]
)
def test_a_hand_may_lean_where_it_does_not_get_upright(reach: Reach, lean: float, phase: str):
    world = at(0, 0, 0, reach=reach)
    leaning = replace(
        world, ee=Pose(world.ee.position, about((0, 1, 0), 0.9 * LEAN) @ world.ee.rotation)
    )
    name, target = rung(leaning)
    assert (name, target.lean) == (phase, lean)


def held(to_goal: tuple[float, float, float], edge: float = EDGE) -> Placed:
    """The cube in the hand, and the goal that far from it."""
    cube = np.array([0.5, 0.1, 0.15])
    return Placed(
        Pose(cube, hand_down(0.0)), Pose(cube, np.eye(3)), cube + to_goal, edge, edge, touching=True
    )


def rung(world: Placed, rungs: tuple[Rung, ...] = RUNGS) -> tuple[str, Target]:
    """The name and target of the first rung that holds."""
    found = next(one for one in rungs if one.holds(world))
    return found.name, found.target(world)


@pytest.mark.parametrize(
    ("world", "name", "opening", "position"),
    [
        (at(-0.2, 0.1, 0.2), "approach", OPEN, [0.5, 0.1, EDGE + HOVER]),
        (at(0, 0, 0.08), "descend", OPEN, [0.5, 0.1, EDGE / 2]),  # all the way
        *(
            (at(0.003, -0.003, 0.004, edge=e), "grasp", 0.0, [0.5, 0.1, max(e / 2, LOWEST)])
            for e in EDGES
        ),
        # over the goal first
        *((held((-0.2, 0.1, 0.0), e), "carry", 0.0, [0.3, 0.2, 0.2]) for e in EDGES),
        # and then down
        *((held((-0.01, 0.0, -0.05), e), "carry", 0.0, [0.49, 0.1, 0.1]) for e in EDGES),
    ],
)
def test_the_ladder_leads_to_the_goal(
    world: Placed, name: str, opening: float, position: list[float]
):
    found, target = rung(world)
    assert (found, target.opening) == (name, opening)
    np.testing.assert_allclose(target.position, position)


@given(st.floats(0.06, 0.2), st.floats(0, 2 * np.pi), st.floats(-0.02, 0.04), widths)
def test_beside_the_object_a_hand_that_is_too_low_only_rises(
    off: float, direction: float, height: float, edge: float
):
    world = at(off * np.cos(direction), off * np.sin(direction), height, edge=edge)
    _, target = rung(world)
    np.testing.assert_array_equal(target.position[:2], world.ee.position[:2])
    assert target.position[2] > world.ee.position[2] + 0.03 - (EDGE - edge) / 2


@given(
    st.floats(-0.1, 0.1), st.floats(-0.1, 0.1), st.floats(-0.01, 0.2), widths, st.sampled_from([0.0, 0.2, OPEN]),
    st.lists(st.floats(-1, 1), min_size=3, max_size=3),
)  # fmt: skip
def test_within_a_rung_targets_are_continuous(
    x, y, z, edge: float, opening: float, way: list[float]
):
    world = at(x, y, z, edge=edge, opening=opening)
    near = world.moved(*(1e-5 * np.array(way)))
    (name, target), (other, beside) = rung(world), rung(near)
    assume(name == other)
    assert np.abs(beside.position - target.position).max() <= steepest * 1e-5
    np.testing.assert_allclose(beside.rotation, target.rotation, atol=1e-9)
    assert beside.opening == target.opening


@pytest.mark.parametrize("opening", [0.0, 0.03, EDGE + OPEN_SLACK / 2])
def test_fingers_that_closed_too_early_open_before_the_hand_descends(opening: float):
    world = at(0, 0, 0.09, opening=opening)
    name, target = rung(world)
    assert (name, target.opening) == ("open", OPEN)
    assert target.position[2] >= EDGE + CLEAR


def test_fingers_that_touch_the_cube_between_them_hold_it_and_others_do_not():
    assert rung(at(0, 0, 0, opening=EDGE, touching=True))[0] == "carry"
    assert rung(at(0, 0, 0, opening=EDGE))[0] != "carry"
    assert rung(at(0.06, 0, 0, opening=EDGE, touching=True))[0] != "carry"
    assert rung(at(0, 0, 0.07, opening=EDGE, touching=True))[0] != "carry"


@pytest.mark.parametrize(
    ("way", "yaw"), [((0.03, 0.0), 0.0), ((0.0, 0.03), np.pi / 2), ((0.0, -0.07), 0.0)]
)
def test_the_fingers_go_down_where_no_neighbour_stands(way: tuple[float, float], yaw: float):
    world = at(0, 0, 0.1, around=(way,))
    assert abs(grasp_of(world, "object").yaw) == pytest.approx(yaw)


def tipped(z: float, tilt: float, turn: float = 0.0, **changes: Any) -> Placed:
    """The hand over a cube that stands on an edge, turned as a grasp of its upright sides wants
    it.
    """
    world = at(0, 0, z, yaw=np.pi / 2, **changes)
    rotation = about((0, 0, 1), turn)
    hand = Pose(world.ee.position, rotation @ world.ee.rotation)
    return replace(
        world, ee=hand, cube=Pose(world.cube.position, rotation @ about((1, 0, 0), tilt))
    )


def test_over_an_object_that_tips_over_the_hand_waits_and_between_the_fingers_it_is_grasped():
    tipping, between = (tipped(z, MAX_TILT + 0.1) for z in (0.03, 0))
    assert rung(tipping)[1].position[2] > tipping.ee.position[2]
    assert rung(between)[0] == "grasp"


@given(st.floats(MAX_TILT + 0.02, np.pi / 2 - MAX_TILT - 0.02), st.floats(-np.pi, np.pi), widths)
def test_an_object_that_leans_on_something_is_gripped_by_its_upright_sides(
    tilt: float, turn: float, edge: float
):
    leaning = tipped(0.06, tilt, turn, edge=edge, resting=True)
    over = replace(leaning, ee=Pose(leaning.ee.position, rung(leaning)[1].rotation))
    name, target = rung(over)
    assert name == "descend"
    assert target.position[2] < edge
    assert abs(float(target.rotation[:, 1] @ leaning.cube.rotation[:, 0])) == pytest.approx(1.0)


@given(
    *[st.floats(-0.2, 0.2)] * 2, st.floats(-0.02, 0.3), st.floats(0, OPEN), widths, st.booleans()
)
def test_no_target_is_in_the_table(
    x: float, y: float, z: float, opening: float, edge: float, touching: bool
):
    world = at(x, y, z, opening=opening, edge=edge, touching=touching)
    assert rung(world)[1].position[2] >= LOWEST
    assert rung(replace(world, goal=np.array([0.5, 0.1, 0.0])))[1].position[2] >= LOWEST


@given(st.floats(-np.pi / 4, np.pi / 4), st.floats(-np.pi, np.pi))
def test_a_grasp_is_one_of_the_cubes_own_and_no_far_turn(object_yaw: float, hand_yaw: float):
    yaw = grasp_of(turned(about((0, 0, 1), object_yaw), yaw=hand_yaw), "object").yaw
    assert np.exp(4j * yaw) == pytest.approx(np.exp(4j * object_yaw), abs=1e-9)
    assert abs(yaw) <= 3 * np.pi / 4


# A cube looks the same on every face.

SYMMETRIES = [
    np.diag(signs)[list(order)]
    for order in itertools.permutations(range(3))
    for signs in itertools.product((1.0, -1.0), repeat=3)
    if np.linalg.det(np.diag(signs)[list(order)]) > 0
]


@given(
    st.floats(-np.pi, np.pi),
    st.floats(0, 2 * np.pi),
    st.floats(0, 0.3),
    st.sampled_from(SYMMETRIES),
)
def test_a_tilted_cubes_tilt_does_not_know_its_face_and_its_yaw_hardly(
    yaw: float, direction: float, tilt: float, symmetry: np.ndarray
):
    rotation = about((np.cos(direction), np.sin(direction), 0.0), tilt) @ about((0, 0, 1), yaw)
    plain, other = (lie_of(turned(one), "object") for one in (rotation, rotation @ symmetry))
    assert other.tilt == pytest.approx(plain.tilt, abs=1e-6)
    assert plain.tilt == pytest.approx(tilt, abs=1e-6)
    apart = np.angle(np.exp(4j * (other.yaw - plain.yaw))) / 4
    # two sides, a right angle apart, seen from above at worst
    between = 2 * np.arctan(np.cos(tilt))
    assert abs(apart) <= np.pi / 2 - between + 1e-6
