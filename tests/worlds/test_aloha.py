"""The two arms of gym_aloha: as gymnasium makes them, restored bit for bit, and solved by their
experts.
"""

import re
from pathlib import Path
from typing import Any

import gymnasium
import numpy as np
import pytest

from manip_il.collect.drivers import ExpertDriver
from manip_il.collect.job import RolloutJob
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.evaluation.measuring import episode_hold
from manip_il.learn.action_spaces import conversion_for
from manip_il.mdp import State
from manip_il.seeding import stream_seeds
from manip_il.sim.config import CameraConfig
from manip_il.worlds.aloha import environment
from manip_il.worlds.aloha.environment import INSTALL, Aloha, AlohaEnv
from manip_il.worlds.config import WORLDS, EnvConfig
from manip_il.worlds.table import env_spec, make_config, make_env, make_expert

ALOHA = Aloha.name
TRANSFER, INSERTION = WORLDS[ALOHA].tasks
every_task = pytest.mark.parametrize("task", [TRANSFER, INSERTION])
SMALL = CameraConfig(("top",), 48, 64)


def config(task: str, **settings: int) -> EnvConfig:
    return make_config(ALOHA, task, **settings)


def made(task: str) -> AlohaEnv:
    return AlohaEnv(Aloha(task))


def theirs(task: str) -> Any:
    __import__("gym_aloha")
    return gymnasium.make(f"gym_aloha/{task}", obs_type="pixels_agent_pos")


def solve(env: AlohaEnv, noise: float = 0.0, seed: int = 0) -> tuple[list[State], bool]:
    """The states of the expert's episode from where `env` is, up to its success.

    A share of the actions is random.
    """
    expert, rng, states = (
        make_expert(config(env.spec.task)),
        np.random.default_rng(seed),
        list[State](),
    )
    solved = False
    while not solved and len(states) < 400:
        states.append(env.get_state())
        random = rng.random() < noise
        action = (
            env.actions.random_near(env.world.measured(), rng)
            if random
            else expert.label(states[-1]).action
        )
        solved = env.step(action).solved
    return states, solved


@every_task
def test_it_is_the_environment_that_gymnasium_makes(task: str):
    other, ours, expert = theirs(task), made(task), make_expert(config(task))
    # a second each
    other.unwrapped._env.physics.render = lambda **_: np.zeros((480, 640, 3), np.uint8)
    seen, _ = other.reset(seed=4_000_007)
    ours.start(4_000_007)
    for _ in range(60):
        assert np.array_equal(ours.observe().state, seen["agent_pos"].astype(np.float32))
        action = expert.label(ours.get_state()).action
        seen, reward, over, _, info = other.step(action)
        assert ours.step(action)[1:3] == (reward, info["is_success"]) == (reward, over)


@pytest.mark.slow
@pytest.mark.gl
def test_pictures_are_the_environments_own():
    other, ours = theirs(TRANSFER), make_env(config(TRANSFER), CameraConfig(("top",), 480, 640))
    seen, _ = other.reset(seed=5)
    ours.start(5)
    assert np.array_equal(ours.observe().images["top"], seen["pixels"]["top"])


@pytest.mark.gl
def test_a_picture_depends_on_the_state_alone():
    env = make_env(config(TRANSFER), CameraConfig(("top", "left_wrist"), 48, 64))
    env.start(1)
    state, before = env.get_state(), env.observe().images
    env.start(2)
    assert not np.array_equal(env.observe().images["top"], before["top"])
    env.set_state(state)
    again = env.observe().images
    assert all(np.array_equal(again[name], before[name]) for name in ("top", "left_wrist"))


@every_task
def test_the_expert_solves_it_and_a_restored_state_goes_on_bit_for_bit(task: str):
    env, other = made(task), made(task)
    env.start(1)
    states, solved = solve(env)
    assert solved
    expert = make_expert(config(task))
    labels = [expert.label(state) for state in states]
    assert all(label.valid for label in labels)
    backwards = [make_expert(config(task)).label(state).action for state in reversed(states)][::-1]
    assert np.array_equal([label.action for label in labels], backwards)
    for begin in (0, len(states) // 2, len(states) - 5):
        other.set_state(State.from_vector(states[begin].to_vector()))
        for step in range(begin, len(states)):
            assert np.array_equal(other.get_state().to_vector(), states[step].to_vector())
            solved = other.step(labels[step].action).solved
        assert solved


@pytest.mark.slow
@every_task
@pytest.mark.parametrize("noise", [0.0, 0.1])
def test_the_expert_solves_what_it_has_not_seen(task: str, noise: float):
    env, solved = made(task), 0
    for seed in stream_seeds("training", 12):
        env.start(seed)
        solved += solve(env, noise, seed)[1]
    assert solved >= 12 - (noise > 0)


def moved(env: AlohaEnv, name: str, place: tuple[float, float, float]) -> State:
    model = env.world.model
    address = model.jnt_qposadr[model.body(name).jntadr[0]]
    env.world.data.qpos[address : address + 3] = place
    return env.get_state()


@pytest.mark.parametrize(
    ("task", "name", "place", "reason"),
    [
        (TRANSFER, "box", (0.1, 0.5, -0.2), "box off the table"),
        (TRANSFER, "box", (-0.5, 0.5, 0.02), "box out of the right arm's reach"),
        (INSERTION, "socket", (0.5, 0.5, 0.02), "socket out of the left arm's reach"),
    ],
)
def test_a_state_without_a_sound_label_says_why_and_holds_still(task, name, place, reason):
    env = made(task)
    label = make_expert(config(task)).label(moved(env, name, place))
    assert (label.valid, label.reason, label.phase) == (False, reason, 0)
    assert np.allclose(label.action, env.world.measured())


def test_arms_that_touch_have_no_label():
    env = made(TRANSFER)
    env.world.data.qpos[[0, 8]] = 0.0
    for joint in (1, 9):
        env.world.data.qpos[joint : joint + 2] = (
            0.55,
            0.2,
        )  # both arms straight ahead, into each other
    label = make_expert(config(TRANSFER)).label(env.get_state())
    assert (label.valid, label.reason) == (False, "the arms touch")


@every_task
def test_names_and_numbers_are_those_of_lerobots_datasets(task: str):
    [episode] = RolloutJob(config(task), hold=3).run(stream_seeds("training", 1))
    spec = env_spec(config(task))
    assert spec.joint_names[:2] == ("left_waist", "left_shoulder")
    assert spec.joint_names[6::7] == ("left_gripper", "right_gripper")
    assert (spec.fps, spec.robot_type or spec.robot, len(spec.joint_names)) == (50, "aloha", 14)
    assert episode.columns["action"].shape[1] == 14
    assert episode.columns["observation.environment_state"].shape[1] == len(
        spec.environment_state_names
    )
    assert episode.columns["sim_state"].shape[1] == spec.sim_state_size
    left = episode.columns["observation.state"][:, 6]
    assert 0 <= left.min() < left.max() < 1.1
    assert episode.success
    assert conversion_for("joint_delta", spec).grippers == (6, 13)


@every_task
def test_positions_are_those_of_the_observation(task: str):
    env = made(task)
    row = dict(
        zip(env.spec.environment_state_names, env.observe().environment_state.tolist(), strict=True)
    )
    found = env.positions()
    first = next(iter(env.world.about.objects))
    for name, observed in {"hand": "right_ee", "object": first}.items():
        assert found[name] == pytest.approx([row[f"{observed}.{axis}"] for axis in "xyz"], abs=1e-4)


@every_task
def test_an_episode_ends_as_the_environments_do(task: str):
    job = RolloutJob(config(task), ExpertDriver(), hold=episode_hold(config(task)), label="last")
    [episode] = job.run([3])
    assert np.array_equal(
        np.flatnonzero(episode.columns["next.success"].ravel()), [len(episode) - 1]
    )


@every_task
def test_a_redrawn_scene_has_free_objects_elsewhere_and_arms_that_take_along_or_drop_what_they_hold(
    task: str,
):
    env, expert, rng = made(task), make_expert(config(task)), np.random.default_rng(0)
    env.start(4)
    states, _ = solve(env)
    for state in (states[10], states[-20]):
        env.set_state(state)
        before = env.world.scene()
        held = {
            name: side
            for side in before.hands
            for name in before.things
            if any(before.touches(side, name))
        }
        assert len(held) == (0 if state is states[10] else len(env.world.about.grasped))
        found = [one for _ in range(25) if (one := env.redrawn(state, rng)) is not None]
        moved, anew, kept = 0, 0, list[bool]()
        for one in found:
            assert expert.label(one).valid
            env.set_state(one)
            after = env.world.scene()
            moved += any(
                (after.hands[side].q != before.hands[side].q).any() for side in before.hands
            )
            for name, thing in after.things.items():
                if name in held:
                    seen = [
                        scene.hands[held[name]].sees(scene.things[name].position)
                        for scene in (before, after)
                    ]
                    kept.append(np.allclose(*seen, atol=1e-6))
                else:
                    anew += bool((thing.position[:2] != before.things[name].position[:2]).all())
        assert 0 < moved < len(found)
        assert not held or 0 < len(kept) - sum(kept) < 0.3 * len(kept)  # some are dropped
        assert (anew > 0) == (len(held) < len(env.world.about.objects))


@pytest.mark.gl
def test_recorded_pictures_have_the_size_asked_for():
    [episode] = RolloutJob(config(TRANSFER, horizon=2), cameras=SMALL).run([1])
    assert episode.columns["observation.images.top"].shape == (2, 48, 64, 3)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"control_hz": 20}, "control_hz is 20; aloha has its own, expected 50"),
        ({"object": "sphere:0.04"}, "object is sphere:0.04; aloha has its own"),
        ({"task": "pick_place"}, "unknown task of aloha 'pick_place'"),
    ],
)
def test_other_settings_are_refused(settings: dict, words: str):
    with pytest.raises(UsageError, match=words):
        make_config(**{"robot": ALOHA, "task": TRANSFER} | settings)


def test_another_robot_or_camera_is_refused():
    with pytest.raises(UsageError, match=f"unknown task '{TRANSFER}'"):
        make_config("panda", TRANSFER)
    for robot, task, camera in ((ALOHA, TRANSFER, "front"), ("panda", "reach", "top")):
        with pytest.raises(UsageError, match=f"unknown camera '{camera}'"):
            env_spec(make_config(robot, task), CameraConfig((camera,)))


def test_a_state_of_the_other_task_is_refused():
    with pytest.raises(MismatchError, match="size of the state"):
        made(TRANSFER).set_state(made(INSERTION).get_state())


def test_without_the_package_one_line_says_how_to_install_it(monkeypatch: pytest.MonkeyPatch):
    def missing(name: str):
        raise ModuleNotFoundError(f"No module named {name!r}", name="gym_aloha")

    monkeypatch.setattr(environment, "import_module", missing)
    with pytest.raises(ManipError, match=re.escape(INSTALL)):
        made(TRANSFER)


def test_the_line_installs_what_the_tests_use():
    lock = (Path(__file__).parents[2] / "robots.lock").read_text()
    for wanted in INSTALL.split()[1:]:
        assert f"\n{wanted} \\\n" in lock
