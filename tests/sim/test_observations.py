"""What a learner is shown: numbers that are what their names say."""

import numpy as np
import pytest

from manip_il.sim.env import ManipEnv, environment_state, environment_state_names
from manip_il.sim.variation import with_drawn
from manip_il.sim.world import World
from manip_il.tasks.sort import asked
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env

from ..scenes import has_goal, started
from ..tables import every_scene, every_scene_with_cubes


def values_of(env: ManipEnv) -> dict[str, float]:
    return dict(
        zip(environment_state_names(env.scene), env.observe().environment_state, strict=True)
    )


def vector(values: dict[str, float], name: str) -> np.ndarray:
    return np.array([values[f"{name}.{axis}"] for axis in "xyz"])


@every_scene
def test_the_hand_and_a_goal_are_shown_where_they_are(robot: str, task: str):
    env = started(robot, task)
    values, ee = values_of(env), env.world.ee
    np.testing.assert_allclose(vector(values, "ee"), ee.position, atol=1e-6)
    np.testing.assert_allclose(vector(values, "ee.axis_y"), ee.rotation[:, 1], atol=1e-6)
    np.testing.assert_allclose(vector(values, "ee.axis_z"), ee.rotation[:, 2], atol=1e-6)
    if has_goal(env.world):
        np.testing.assert_allclose(vector(values, "goal"), env.world.goal, atol=1e-6)
        np.testing.assert_allclose(env.world.goal, env.data.mocap_pos[0])


@every_scene_with_cubes
def test_the_cubes_numbers_are_what_their_names_say(robot: str, task: str):
    env = started(robot, task)
    values = values_of(env)
    thing = asked(env.world) if task == "sort" else TASKS[task].grasped[0]
    name = {"sort": "cube", "clear_table": "next"}.get(task, thing)  # the one that it is about now
    place, hand = vector(values, name), vector(values, "ee")
    np.testing.assert_allclose(place, env.data.joint(thing).qpos[:3], atol=1e-6)
    np.testing.assert_allclose(vector(values, f"{name}_from_ee"), place - hand, atol=1e-6)
    w, _, _, z = env.data.joint(thing).qpos[3:]
    turns = np.exp(4j * 2 * np.arctan2(z, w))
    assert (values[f"{name}.cos4yaw"], values[f"{name}.sin4yaw"]) == pytest.approx(
        (turns.real, turns.imag), abs=1e-6
    )
    assert values[f"{name}.tilt"] == pytest.approx(0, abs=1e-6)
    assert values[f"{name}.width"] == pytest.approx(env.world.extents(thing)[0])
    env.world.vary(with_drawn(env.scene.nominal, {"size": 0.03}))
    env.world.update()
    assert values_of(env)[f"{name}.width"] == pytest.approx(0.03)


@every_scene
def test_every_number_has_a_name_and_the_same_whatever_the_world_is_like(robot: str, task: str):
    env = make_env(robot, task)
    names = environment_state_names(env.scene)
    env.start(1)
    environment_state_names.cache_clear()
    assert environment_state_names(env.scene) == names
    assert len(environment_state(World(env.scene))) == len(names) == len(set(names))
