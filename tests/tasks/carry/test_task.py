"""Carry: nothing is touched, the way is a reward's, and the reward is part of the state but is
not observed.
"""

from itertools import combinations

import numpy as np
import pytest

from manip_il import Expert
from manip_il.sim.env import ManipEnv, environment_state, environment_state_names
from manip_il.sim.task import phases
from manip_il.sim.world import GOAL, World
from manip_il.tasks.carry.layout import OBSTACLES, TASTES
from manip_il.tasks.carry.obstacles import (
    EDGE,
    TASTE_BODIES,
    is_there,
    layout_of,
    observed_layout,
    reward_in,
)
from manip_il.tasks.carry.task import OBJECT, descent_of
from manip_il.tasks.objects import UPRIGHT
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env

from ...scenes import SEED, drive_until, started
from ...tables import every_robot
from .features import path_features

STARTS = range(SEED, SEED + 6)
PHASES = phases(TASKS["carry"])


def touched(env: ManipEnv) -> set[str]:
    """The obstacles that something touches."""
    geoms = {env.scene.model.geom(name).id: name for name in OBSTACLES}
    return {geoms[geom] for geom in env.data.contact.geom.ravel().tolist() if geom in geoms}


def carried(env: ManipEnv) -> np.ndarray:
    """Drive to the end; the object's path in the hand, (T, 3). Nothing may be touched."""
    expert, path = Expert(env.scene), []
    while not env.solved:
        assert env.get_state().step < env.config.horizon
        label = expert.label(env.get_state())
        assert label.valid
        if PHASES[label.phase] in ("carry", "at_goal"):
            path.append(env.world.pose(OBJECT).position.copy())
        env.advance(label.action)
        assert not touched(env)
    return np.array(path)


@pytest.mark.parametrize("taste", TASTES)
@every_robot
def test_the_expert_touches_nothing_on_its_way(robot: str, taste: str):
    for seed in STARTS:
        assert len(carried(started(robot, f"carry:{taste}", seed))) > 3


def test_a_tastes_own_way_costs_it_less_than_anothers():
    costs = {taste: {other: 0.0 for other in TASTES} for taste in TASTES}
    for seed in range(SEED, SEED + 6):
        for taste in TASTES:
            env = started("panda", f"carry:{taste}", seed)
            features = path_features(layout_of(env.world), carried(env))
            for other in TASTES:
                costs[taste][other] += features @ np.array(TASTES[other].weights)
    for taste in TASTES:
        assert costs[taste][taste] == min(costs[other][taste] for other in TASTES)


def test_the_reward_is_the_states_and_not_observed():
    careful, low = (started("panda", f"carry:{taste}") for taste in ("careful", "low"))
    assert (reward_in(careful.world), reward_in(low.world)) == (TASTES["careful"], TASTES["low"])
    np.testing.assert_array_equal(environment_state(careful.world), environment_state(low.world))
    for env in (careful, low):
        drive_until(env, "carry")
    low.set_state(careful.get_state())
    assert reward_in(low.world) == TASTES["careful"]
    for name, weights in zip(TASTE_BODIES, np.reshape(TASTES["low"].weights, (-1, 3)), strict=True):
        low.world.place(name, weights, UPRIGHT)
    low.world.update()
    expert = Expert(careful.scene)
    assert (expert.label(careful.get_state()).action != expert.label(low.get_state()).action).any()


def test_neighbouring_positions_head_alike():
    rng, turns = np.random.default_rng(0), []
    for seed in STARTS:
        env = started("panda", "carry", seed)
        drive_until(env, "carry")
        expert = Expert(env.scene)
        while not env.solved:
            down, at = descent_of(env.world), env.world.pose(OBJECT).position.copy()
            near = at + rng.normal(0, 1e-3 / np.sqrt(3), 3)
            one, other = down.look(at)[1], down.look(near)[1]
            if one is not None and other is not None:
                turns.append(float(np.linalg.norm((one - at) - (other - near))))
            env.advance(expert.label(env.get_state()).action)
    assert np.median(turns) < 0.002
    assert np.quantile(turns, 0.95) < 0.01


@every_robot
def test_one_to_four_obstacles_stand_where_they_leave_room(robot: str):
    env, counts = make_env(robot, "carry"), []
    for seed in range(SEED, SEED + 40):
        env.start(seed)
        there = [name for name in (*OBSTACLES, EDGE) if is_there(env.world, name)]
        counts.append(len(there))
        layout = layout_of(env.world)
        for (_, at, half, _), (_, other, its, _) in combinations(layout.boxes, 2):
            assert (np.abs(at - other) > half + its).any()
        ends = np.array([env.world.pose(OBJECT).position, env.world.goal])
        assert layout.room(ends).min() >= 0
        if layout.edge is not None:
            assert (
                (np.array(layout.edge.at) - ends[:, :2]) @ np.array(layout.edge.outwards) > 0
            ).all()
    assert set(counts) == {1, 2, 3, 4} if robot != "so101" else set(counts) >= {1, 2, 3}


def test_what_is_observed_is_the_layout():
    names = environment_state_names(started(task="carry").scene)
    for seed in STARTS:
        world = started("panda", "carry", seed).world
        seen = dict(zip(names, environment_state(world).tolist(), strict=True))
        layout, observed = layout_of(world), observed_layout(world.scene, seen)
        assert [name for name, _ in observed.places] == [name for name, _ in layout.places]
        points = np.array([*world.scene.robot.workspace.centre, 0.1]) + np.random.default_rng(
            0
        ).uniform(-0.1, 0.1, (50, 3))
        np.testing.assert_allclose(observed.densities(points), layout.densities(points), atol=1e-4)
        np.testing.assert_allclose(observed.room(points), layout.room(points), atol=1e-6)
        assert not {name for name in seen if name.startswith("taste")}


def place(world: World, name: str, at: np.ndarray) -> None:
    world.place(name, np.array([*at[:2], 0.0]), UPRIGHT)
    world.update()


def test_without_a_free_path_or_room_a_label_is_none_and_says_why():
    env = started("panda", "carry")
    expert, state = Expert(env.scene), env.get_state()
    assert expert.label(state).valid
    place(env.world, GOAL, env.world.goal)
    place(env.world, "vase", env.world.goal)
    label = expert.label(env.get_state())
    assert (label.valid, label.reason) == (False, "no free path to the goal")
    env.set_state(state)
    for name in OBSTACLES:
        env.world.place(name, np.array([0.45, 0.0, -0.25]), UPRIGHT)
    place(env.world, "vase", env.world.pose(OBJECT).position + [0.06, 0.06, 0.0])
    assert expert.label(env.get_state()).reason == "no room for the hand beside an obstacle"


def test_an_object_beside_a_low_obstacle_is_grasped_where_the_hand_fits():
    env = started("panda", "carry")
    for name in (*OBSTACLES, EDGE):
        env.world.place(name, np.array([0.45, 0.0, -0.25]), UPRIGHT)
    env.world.place(GOAL, np.array([0.45, 0.1, 0.15]), UPRIGHT)
    env.world.place(OBJECT, np.array([0.45, -0.1, 0.025]), UPRIGHT)
    place(env.world, "laptop", np.array([0.545, -0.1, 0.0]))
    assert layout_of(env.world).room(env.world.pose(OBJECT).position[None])[0] < -0.012
    carried(env)
