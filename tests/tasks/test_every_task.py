"""What holds for every task on every robot: its ladder, its progress, its end, its name in a
fingerprint.
"""

import copy
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pytest

from manip_il import Expert
from manip_il.collect.drivers import driver_of
from manip_il.collect.job import RolloutJob
from manip_il.data.schema import EXPERT_PHASE
from manip_il.mdp import State
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.events import STANDARD
from manip_il.sim.scene import Scene
from manip_il.sim.task import NO_PHASE, phases
from manip_il.sim.world import GOAL, World
from manip_il.tasks import NAMES
from manip_il.tasks.objects import UPRIGHT
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder import world
from manip_il.worlds.ladder.world import make_env, scene_of
from manip_il.worlds.table import env_fingerprint, env_spec, make_config, world_of

from ..scenes import has_goal, sizes_of, started, still
from ..tables import SCENES, WITH_A_CUBE, every_scene, every_task

SEEDS = stream_seeds("certificate", 2)
FALL = 0.002  # that progress may have where it should not fall at all
RARE = {  # rungs with tests of their own
    "drawer": {"set_down", "put_aside", "make_way", "to_make_way", "leave"},
    "insert": {"let_stand"},
    "insert_tight": {"let_stand"},
    "sort": {"put_back"},
}


def test_help_names_every_task():
    assert list(NAMES) == list(TASKS)


def test_docs_show_every_task():
    docs = Path(__file__).parents[2] / "docs"
    page, plugin = (docs / "tasks.md").read_text(), (docs / "lerobot.md").read_text()
    for task in TASKS:
        assert f"## `{task}`" in page
        assert (docs / "tasks" / f"{task}.jpg").stat().st_size < 150_000
        assert f"`Panda{task.title().replace('_', '')}-v0`" in plugin


@every_task
def test_phases_are_none_and_then_the_rungs_from_the_first_on(task: str):
    names = phases(TASKS[task])
    assert names[0] == NO_PHASE
    assert len(set(names)) == len(names)
    assert list(names[:0:-1]) == [rung.name for rung in TASKS[task].rungs]


@every_task
def test_colours_that_texts_name_are_not_drawn(task: str):
    paint = Condition("paint", colour=(0.1, 0.9))
    kept = world_of("panda", task).affecting(make_config("panda", task), paint, sees=True)
    nouns = [TASKS[task].noun(name) for name in TASKS[task].objects]
    named = any({"red", "blue", "yellow"} & set(noun.split()) for noun in nouns)
    assert (kept is not None) == (bool(nouns) and not named)


@every_scene
def test_the_last_rung_holds_everywhere(robot: str, task: str):
    world, rng = World(scene_of(robot, task)), np.random.default_rng(0)
    scene = world.scene
    for _ in range(20):
        world.data.qpos[scene.arm_q] = np.asarray(scene.robot.home) + rng.uniform(
            -1, 1, len(scene.robot.joints)
        )
        world.data.qpos[scene.gripper.q] = scene.gripper.command(rng.uniform(0, 0.1))
        for name in scene.objects:
            turn = rng.normal(size=4)
            world.place(name, rng.uniform(-1, 1, 3), turn / np.linalg.norm(turn))
        world.update()
        assert 0 <= TASKS[task].progress(world) <= 1
        assert TASKS[task].rungs[-1].holds(world)
        for rung in TASKS[task].rungs:
            target = rung.target(world)
            assert np.isfinite([*target.position, *target.rotation.ravel(), target.opening]).all()
            np.testing.assert_allclose(target.rotation @ target.rotation.T, np.eye(3), atol=1e-9)


@every_task
def test_every_rung_of_the_ladder_occurs(task: str):
    seen = set[str]()
    for driver, conditions, horizon in (
        ("expert", (), 0),
        ("expert", (STANDARD,), 120),
        ("random", (), 45),
    ):
        job = RolloutJob(
            make_config("panda", task, horizon=horizon),
            driver_of(driver),
            hold=2,
            conditions=conditions,
        )
        for episode in job.run(SEEDS):
            seen |= {
                phases(TASKS[task])[phase]
                for phase in set(episode.columns[EXPERT_PHASE].ravel().tolist())
            }
    missing = {rung.name for rung in TASKS[task].rungs} - seen
    assert missing <= RARE.get(task, set())


class Driven(NamedTuple):
    """One of the expert's episodes: progress along it, and the state it ended in."""

    path: list[float]
    solved: bool
    last: State


@cache
def driven_by_expert(robot: str, task: str, other_cubes: bool = False) -> list[Driven]:
    paths = []
    for seed in SEEDS:
        env = started(robot, task, seed, conditions=sizes_of(task) if other_cubes else [])
        expert, path = Expert(env.scene), []
        while not env.solved and len(path) < env.config.horizon:
            path.append(env.progress)
            env.advance(expert.label(env.get_state()).action)
        paths.append(Driven([*path, env.progress], env.solved, env.get_state()))
    return paths


@pytest.mark.parametrize(
    ("robot", "task", "other_cubes"),
    [*((*scene, False) for scene in SCENES), *((*scene, True) for scene in WITH_A_CUBE)],
)
def test_progress_never_falls_along_the_experts_path_and_ends_at_one(
    robot: str, task: str, other_cubes: bool
):
    for path, solved, _ in driven_by_expert(robot, task, other_cubes):
        assert solved
        assert 0 <= min(path) <= path[0] < 0.9
        assert np.diff(path).min() > -FALL
        assert max(path) <= 1
        assert path[-1] > 1 - FALL


@every_scene
def test_what_is_solved_is_at_the_goal_within_the_tolerance_and_what_is_not_is_not(
    robot: str, task: str
):
    env, fresh = make_env(robot, task), make_env(robot, task)
    for driven in driven_by_expert(robot, task):
        assert driven.solved
        env.set_state(driven.last)
        assert TASKS[task].error(env.world) == env.distance() < env.config.tolerance
        if has_goal(env.world):
            world = env.world
            at = (
                world.pose(TASKS[task].objects[0]).position
                if TASKS[task].objects
                else world.ee.position
            )
            assert np.linalg.norm((at - world.goal)[:2]) < env.config.tolerance
            fresh.set_state(env.get_state())
            fresh.world.place(GOAL, fresh.world.goal + [0.1, 0.0, 0.0], UPRIGHT)
            fresh.world.update()
        else:
            fresh.start(SEEDS[0])
        fresh.advance(still(fresh, 0.0))
        assert fresh.distance() > fresh.config.tolerance
        assert not fresh.solved
        assert fresh.progress < env.progress


@pytest.mark.parametrize(
    "change", ["actuator_gainprm", "body_mass", "geom_friction", "body_pos", "qpos0"]
)
def test_the_fingerprint_changes_with_the_model(change: str, monkeypatch):
    config, scene = make_config(), scene_of("panda", "pick_place")
    before = env_fingerprint(config)
    model = copy.copy(scene.model)
    getattr(model, change)[...] += 1e-6
    monkeypatch.setattr(world, "config_scene", lambda _: Scene(scene.robot, scene.task, model))
    after = world.WORLD.fingerprint(config)
    assert {key for key in before if before[key] != after[key]} == {"model_sha256"}


def test_the_fingerprint_is_the_scenes_and_the_settings():
    plain = env_fingerprint(make_config())
    assert env_fingerprint(make_config()) == plain
    longer = env_fingerprint(make_config(horizon=99))
    assert {key for key in plain if plain[key] != longer[key]} == {"config_sha256"}


@every_scene
def test_a_datasets_words_fit_the_scene(robot: str, task: str):
    spec, env = env_spec(make_config(robot, task)), started(robot, task)
    seen, state = env.observe(), env.get_state()
    assert len(spec.joint_names) == len(seen.state) == len(env.scene.actions)
    assert len(spec.environment_state_names) == len(seen.environment_state)
    assert spec.sim_state_size == len(state.to_vector())
    assert spec.phases == phases(TASKS[task])
    assert seen.instruction == env.task_description
    assert task == "sort" or spec.instruction == env.task_description
