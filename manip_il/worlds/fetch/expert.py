"""Experts of Fetch: ladders over gripper, cube and goal, the task's last rung first.

A ladder reads the state from a `FetchScene`, and returns the name of the first rung that holds and
its target: the gripper's displacement, (3,) [m], and the fingers' command, -1 to 1. An action of 1
moves the gripper by about `REACH` in a control step along each axis independently, so that the
longest of x, y and z determines how long a move takes.
"""

import itertools
from typing import Any, NamedTuple

import numpy as np

from manip_il.mdp import F64

REACH = 0.032  # displacement of the gripper in one control step at an action of 1 [m]
OPEN, CLOSE = 1.0, -1.0
HALF = 0.025  # half the cube's edge length [m]

# Pick and place; heights are the gripper's over the cube's middle
GRASP_HEIGHT = 0.0145  # [m]
CLEAR = 0.053  # height at which the fingers pass over the cube [m]
# offset from the cube in y from which the gripper gets over it while descending [m]
STRADDLE = 0.042
# distance that the gripper still covers while the fingers close [m]
NEAR = np.array([0.082, 0.04, 0.082])
OPENING = 0.25  # extra opening needed per distance of the cube in x, a ratio
LEAD = 0.04  # largest lead of the gripper in y towards the goal while the fingers close [m]
CLOSED_ON = 0.03  # distance to the grasp at which that lead begins [m]
# largest offset from the cube in x, y, z if the fingers hold it [m]
GRASPED = np.array([0.03, 0.026, 0.04])
HELD = 0.054  # opening below which the fingers hold the cube [m]

# Push
# half sides of the area blocked to the gripper's middle by the cube [m]
BOX = np.array([HALF + 0.0135, HALF + 0.0155])
# waypoints around it [m]
CORNERS = [np.array([x, y]) * (BOX + 0.01) for x in (-1, 1) for y in (-1, 1)]
# heights of the gripper over the cube's middle, to push it and to pass over it [m]
LOW, HIGH = 0.012, 0.05
AHEAD = 0.004  # gap between gripper and cube on arrival behind it [m]
# offsets from the place behind the cube within which the gripper pushes [m]
ALONG = 0.028
ACROSS = 0.021
BELOW = 0.03
LOOK = 0.003  # how far ahead the pushed cube's motion is predicted [s]
DECELERATION = 9.0  # deceleration of a cube that slides on the table [m/s^2]
AT_GOAL = 0.05  # [m]
# share of the distance to the line through cube and goal that the gripper corrects in a step
CENTRING = 0.35
DETOUR = 0.03  # extra length of the path around the cube from which the gripper goes over it [m]
DOWN = 0.5  # share of a step after which a gripper that descends past the cube must be beside it
LEG = 0.005  # cost of every leg of a path around the cube, added to its length [m]


class FetchScene(NamedTuple):
    """What the ladders read from a state.

    Attributes:
        gripper: Position between the fingers, (3,) [m].
        opening: Distance between the fingers [m].
        object: Position of the cube, or of the gripper if there is no cube, (3,) [m].
        object_velocity: Its velocity, (3,) [m/s].
        goal: Desired goal, (3,) [m].
    """

    gripper: F64
    opening: float
    object: F64
    object_velocity: F64
    goal: F64


def scene_of(env: Any) -> FetchScene:
    """Return what the ladders read from the present state of an environment."""
    inner = env.unwrapped
    model, data = inner.model, inner.data
    fingers = (data.joint(f"robot0:{side}_gripper_finger_joint").qpos[0] for side in "rl")
    moved = "object0" if inner.has_object else "robot0:grip"
    return FetchScene(
        data.site("robot0:grip").xpos,
        float(sum(fingers)),
        data.site(moved).xpos,
        inner._utils.get_site_xvelp(model, data, moved),
        inner.goal,
    )


def _to_cube(scene: FetchScene) -> F64:
    """Vector from gripper to cube, (3,) [m]."""
    return scene.object - scene.gripper


def _to_grasp(scene: FetchScene) -> F64:
    """Vector from gripper to where it grasps the cube, (3,) [m]."""
    return _to_cube(scene) + [0, 0, GRASP_HEIGHT]


def _holds(scene: FetchScene) -> bool:
    return bool((np.abs(_to_grasp(scene)) < GRASPED).all() and scene.opening < HELD)


def _between(scene: FetchScene) -> bool:
    """Whether the cube is between the fingers, or will be before they have closed."""
    wide = scene.opening > 2 * HALF + OPENING * max(0.0, abs(_to_grasp(scene)[0]) - 0.02)
    return wide and bool((np.abs(_to_grasp(scene)) < NEAR).all())


def _grasp(scene: FetchScene) -> F64:
    """Go to the cube; close to it, lead towards the goal, so that a finger takes the cube along."""
    way = _to_grasp(scene)
    share = max(0.0, 1 - np.abs(way).max() / CLOSED_ON)
    way[1] += share * np.clip(scene.goal[1] - scene.object[1], -LEAD, LEAD)
    return way


def _over(scene: FetchScene) -> F64:
    """Go to the cube, but not below its top before the fingers are on both sides of it."""
    way = _to_grasp(scene)
    if abs(way[1]) > STRADDLE or scene.opening < 2 * HALF + 0.01:
        way[2] = max(way[2], _to_cube(scene)[2] + CLEAR)
    return way


def _rests_at_goal(scene: FetchScene) -> bool:
    """Whether the cube is at the goal, or will slide there by itself."""
    velocity = scene.object_velocity[:2]
    left = (scene.goal - scene.object)[:2] - velocity * np.hypot(*velocity) / (2 * DECELERATION)
    return bool(np.hypot(*left) < AT_GOAL)


def _direction(scene: FetchScene) -> F64:
    """Direction in which to move the cube, a unit vector in the plane, (2,)."""
    way = (scene.goal - scene.object)[:2] - LOOK * scene.object_velocity[:2]
    return way / max(float(np.hypot(*way)), 1e-6)


def _touching(direction: F64) -> float:
    """Distance between gripper and cube when the gripper touches it from behind [m]."""
    return float(min(BOX / np.maximum(np.abs(direction), 1e-6)))


def _is_behind(scene: FetchScene) -> bool:
    direction, way = _direction(scene), _to_cube(scene)[:2]
    along, off = way @ direction, abs(way[0] * direction[1] - way[1] * direction[0])
    return bool(
        0 < along < _touching(direction) + ALONG and off < ACROSS and -_to_cube(scene)[2] < BELOW
    )


def _push(scene: FetchScene) -> F64:
    """Move at full speed in the direction to push, and towards the line through cube and goal."""
    direction = _direction(scene)
    across = np.array([-direction[1], direction[0]])
    way = direction * (REACH / np.abs(direction).max()) + CENTRING * across * (
        _to_cube(scene)[:2] @ across
    )
    return np.append(way, _to_cube(scene)[2] + LOW)


def _ends(scene: FetchScene) -> tuple[F64, F64]:
    """Positions of the gripper now and behind the cube, both relative to the cube, (2,) [m]."""
    direction = _direction(scene)
    return -_to_cube(scene)[:2], -direction * (_touching(direction) + AHEAD)


def _around(scene: FetchScene) -> F64:
    """Go behind the cube, past its corners, as far as one step goes."""
    start, end = _ends(scene)
    return np.append(_walk(start, _path(start, end)), _to_cube(scene)[2] + LOW)


def _is_better_over(scene: FetchScene) -> bool:
    """Whether the cube is in the way, and the path around it is long or the gripper is high
    already.
    """
    start, end = _ends(scene)
    height = -_to_cube(scene)[2]
    if _is_free(start, end) or (_is_inside(start) and height < HIGH - 0.02):
        return False
    around = sum(
        float(np.abs(two - one).max())
        for one, two in itertools.pairwise([start, *_path(start, end)])
    )
    return height >= HIGH - 0.015 or around - np.abs(end - start).max() >= DETOUR


def _over_cube(scene: FetchScene) -> F64:
    """Go straight over the cube to behind it: rise before crossing it, and descend as soon as it
    is past.
    """
    start, end = _ends(scene)
    way = _walk(start, [end])
    if not _is_inside(start) and REACH - _to_cube(scene)[2] < HIGH:
        share = next((one for one in (1, 0.75, 0.5, 0.25) if not _is_inside(start + one * way)), 0)
        return np.append(share * way, _to_cube(scene)[2] + HIGH)
    soon = start + DOWN * way
    height = LOW if not _is_inside(soon) and _is_free(soon, end) else HIGH
    return np.append(way, _to_cube(scene)[2] + height)


def _is_inside(place: F64) -> bool:
    return bool((np.abs(place) < BOX).all())


def _path(start: F64, end: F64) -> list[F64]:
    """Points (2,) of the fastest path around the cube, relative to it; the last is the end [m]."""
    if _is_free(start, end):
        return [end]
    ways = [[one, end] for one in CORNERS if _is_free(one, end)]
    ways += [
        [one, two, end]
        for one in CORNERS
        for two in CORNERS
        if _is_free(one, two) and _is_free(two, end)
    ]
    seen = [way for way in ways if _is_free(start, way[0])]
    return min(seen or ways or [[end]], key=lambda way: _length([start, *way]))


def _length(points: list[F64]) -> float:
    return sum(float(np.abs(two - one).max()) + LEG for one, two in itertools.pairwise(points))


def _walk(start: F64, points: list[F64]) -> F64:
    """Displacement (2,) after one step along the points [m]."""
    at, rest = start, REACH
    for point in points:
        way = point - at
        length = float(np.abs(way).max())
        if length > rest:
            return at + way * (rest / length) - start
        at, rest = point, rest - length
    return at - start


def _is_free(start: F64, end: F64) -> bool:
    """Whether a straight line misses the cube; both ends relative to the cube, (2,) [m]."""
    way, box = end - start, BOX - 0.001
    flat = np.abs(way) < 1e-9
    if (flat & (np.abs(start) >= box)).any():
        return True
    near, far = (np.divide(side - start, way, out=np.zeros(2), where=~flat) for side in (-box, box))
    enters = np.where(flat, -np.inf, np.minimum(near, far)).max()
    leaves = np.where(flat, np.inf, np.maximum(near, far)).min()
    return bool(enters >= leaves or leaves <= 0 or enters >= 1)


def _reach_task(scene: FetchScene) -> tuple[str, F64, float]:
    return "approach", scene.goal - scene.gripper, CLOSE


def _push_task(scene: FetchScene) -> tuple[str, F64, float]:
    if _rests_at_goal(scene):
        return "hold", np.zeros(3), CLOSE
    if _is_behind(scene):
        return "push", _push(scene), CLOSE
    way = _over_cube(scene) if _is_better_over(scene) else _around(scene)
    return "approach", way, CLOSE


def _pick_task(scene: FetchScene) -> tuple[str, F64, float]:
    if _holds(scene):
        return "carry", scene.goal - scene.object, CLOSE
    if _between(scene):
        return "grasp", _grasp(scene), CLOSE
    return "approach", _over(scene), OPEN


# task -> its ladder: the phase, the gripper's displacement (3,) [m] and the fingers' command
LADDERS = {
    "FetchReach-v4": _reach_task,
    "FetchPush-v4": _push_task,
    "FetchPickAndPlace-v4": _pick_task,
}
