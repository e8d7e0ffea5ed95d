"""The map of where a hand gets to is made of solutions of inverse kinematics, worked out once
and kept.
"""

import os
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.robots import reach
from manip_il.robots.geometry import angle_between, hand_down, off_yaw
from manip_il.robots.ik import ArmIK
from manip_il.robots.reach import ARRIVES, STRETCH, Reach, reach_of
from manip_il.robots.robot import Robot
from manip_il.robots.table import get_robot
from manip_il.tasks.grasp import LEAN

from ..tables import every_robot
from .own import model_of, write

CELL = 0.05  # of a map [m]
rng = np.random.default_rng(0)
MAP = Reach(np.array([0.2, -0.1, 0.0]), np.maximum(0.0, rng.normal(0.005, 0.01, (6, 5, 4))))
TOP = MAP.origin + CELL * (np.array(MAP.errors.shape) - 1)
shares = st.tuples(*[st.floats(0, 0.999)] * 3)
read_again = reach_of.__wrapped__  # without what this process remembers


def within(share: tuple[float, ...]) -> np.ndarray:
    return MAP.origin + np.array(share) * (TOP - MAP.origin)


def corners(position: np.ndarray) -> np.ndarray:
    x, y, z = np.floor((position - MAP.origin) / CELL).astype(int)
    return MAP.errors[x : x + 2, y : y + 2, z : z + 2]


@given(shares)
def test_between_points_of_the_grid_the_error_is_between_theirs(share: tuple[float, ...]):
    around = corners(within(share))
    assert around.min() - 1e-9 <= MAP.error(within(share)) <= around.max() + 1e-9


@given(shares)
def test_a_place_is_reached_where_all_its_cell_is(share: tuple[float, ...]):
    assert MAP.has(within(share)) == bool((corners(within(share)) < ARRIVES).all())
    if MAP.has(within(share)):
        assert MAP.nearly(within(share))


@given(shares, st.integers(0, 2), st.floats(0.001, 3), st.booleans())
def test_beyond_the_map_nothing_is_reached_and_the_error_grows(
    share, axis: int, beyond: float, above: bool
):
    inside = within(share)
    inside[axis] = TOP[axis] if above else MAP.origin[axis]
    outside = inside.copy()
    outside[axis] += beyond if above else -beyond
    assert not MAP.has(outside)
    assert MAP.error(outside) == pytest.approx(MAP.error(inside) + beyond, abs=1e-6)
    assert MAP.nearly(outside) == (MAP.error(outside) < STRETCH)


def solve_from_home(
    ik: ArmIK, robot: Robot, position: np.ndarray, lean: float = 0.0
) -> tuple[float, float]:
    """How far the hand, told to point down, ends from a position [m], and from pointing down
    [rad].
    """
    q, down = np.asarray(robot.home, dtype=np.float64), hand_down(ik.ahead(position))
    for _ in range(120):
        ik.ee_pose(q)
        step = ik.step(position, down, robot.max_joint_step, lean)
        assert step is not None
        q = np.clip(q + step[0], ik.limits[:, 0], ik.limits[:, 1])
    at, rotation = ik.ee_pose(q)
    angle = off_yaw(rotation, ik.ahead(position)) if robot.leans else angle_between(rotation, down)
    return float(np.linalg.norm(at - position)), angle


@every_robot
def test_what_the_map_has_inverse_kinematics_reaches(robot: str):
    the_robot = get_robot(robot)
    there, ik, draws = reach_of(the_robot), ArmIK(the_robot), np.random.default_rng(1)
    centre, space = np.array(the_robot.workspace.centre), the_robot.workspace
    tried = 0
    for _ in range(40):
        xy = centre + draws.uniform(-1, 1, 2) * space.half_width
        position = np.array([*xy, draws.uniform(0.02, space.height)])
        if there.has(position):
            tried += 1
            miss, angle = solve_from_home(ik, the_robot, position)
            assert miss < 0.005
            assert angle < 0.1
    assert tried > 20


@pytest.mark.parametrize("x", [0.19, 0.86])  # near the base and far from it [m]
def test_a_hand_that_leans_gets_where_an_upright_one_does_not(x: float):
    the_robot, place = get_robot("panda"), np.array([x, 0.02, 0.025])
    there, ik = reach_of(the_robot), ArmIK(the_robot)
    assert not there.nearly(place)
    assert there.leaning(place)
    assert there.lean(place) == 1
    assert solve_from_home(ik, the_robot, place)[0] > 0.02
    miss, angle = solve_from_home(ik, the_robot, place, 1.0)
    assert miss < 0.006
    assert angle < LEAN


@pytest.fixture
def solved(monkeypatch, tmp_path: Path) -> list[str]:
    """Names of the robots whose maps were worked out.

    What is kept lies in a folder of the test's own.
    """
    names: list[str] = []

    def solve(robot: Robot) -> Reach:
        names.append(robot.name)
        return MAP

    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(reach, "_solve", solve)
    return names


def test_a_map_is_the_same_whether_it_is_worked_out_or_read(
    own: Robot, monkeypatch, tmp_path: Path
):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    monkeypatch.setattr(reach, "_BEYOND", -0.05)  # a map of a few points
    monkeypatch.setattr(reach, "_STEPS", 30)
    first, again = read_again(own), read_again(own)
    assert first.errors.tobytes() == again.errors.tobytes()
    assert first.has(np.array([0.41, 0.01, 0.06]))


@pytest.mark.parametrize(
    ("change", "maps"),
    [
        (lambda text: text.replace("-2.9 2.9", "-2.9 2.8"), 2),
        (lambda text: f"{text}<!-- later -->", 1),
        (lambda text: text, 1),  # the same robot elsewhere
    ],
)
def test_another_model_has_a_map_of_its_own(
    change: Callable[[str], str], maps: int, solved: list[str], tmp_path: Path
):
    for folder, text in ((tmp_path / "one", model_of()), (tmp_path / "other", change(model_of()))):
        folder.mkdir()
        read_again(get_robot(write(folder, model=text)))
    assert solved == ["own"] * maps
    assert len(list((tmp_path / "cache" / "manip_il").iterdir())) == maps


def test_a_link_in_place_of_a_map_is_not_written_to(own: Robot, solved: list[str], tmp_path: Path):
    path, letter = reach._place(own), tmp_path / "letter"
    path.parent.mkdir(parents=True)
    letter.write_text("dear reader")
    path.symlink_to(letter)
    path.with_suffix(f".{os.getpid()}").symlink_to(letter)
    assert read_again(own) is MAP
    assert letter.read_text() == "dear reader"
