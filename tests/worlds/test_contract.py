"""The contract of a world, kept by each kind: what is named is there, and what it cannot do it
says in one line.
"""

import dataclasses

import numpy as np
import pytest

from manip_il.checks import tasks_in
from manip_il.errors import UsageError
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.world import EnvironmentSpec
from manip_il.worlds.config import WORLDS
from manip_il.worlds.several import PRESENT, divide, task_number
from manip_il.worlds.table import env_spec, make_config, make_env, make_expert, task_names

SEVERAL = ("panda", "lift,reach,stack")
KINDS = [
    ("panda", "sort"),
    SEVERAL,
    *((str(robot), world.tasks[-1]) for robot, world in WORLDS.items()),
]
every_kind = pytest.mark.parametrize(("robot", "task"), KINDS)


@every_kind
def test_a_spec_says_what_an_environment_gives(robot: str, task: str):
    config = make_config(robot, task)
    env, spec = make_env(config), env_spec(config)
    env.start(stream_seeds("training", 1)[0])
    seen, state = env.observe(), env.get_state()
    assert env.spec == spec == EnvironmentSpec.from_json(spec.to_json())
    assert (len(spec.joint_names), len(spec.environment_state_names)) == (
        len(seen.state),
        len(seen.environment_state),
    )
    assert len(state.to_vector()) == spec.sim_state_size
    assert (spec.fps, spec.horizon) == (config.control_hz, config.horizon)
    label = make_expert(config).label(state)
    assert np.array_equal(make_expert(config).label(state, env).action, label.action)
    assert label.phase < len(spec.phases)
    assert {"hand"} < env.positions().keys()


@every_kind
def test_a_restored_state_goes_on_the_same(robot: str, task: str):
    config = make_config(robot, task)
    one, other = make_env(config), make_env(config)
    one.start(stream_seeds("training", 1)[0])
    one.observe()
    state = one.get_state()
    action = make_expert(config).label(state).action
    after = [env.step(action) for env in (one, other) if env is one or not other.set_state(state)]
    assert after[0][1:] == after[1][1:]
    assert np.array_equal(one.get_state().to_vector(), other.get_state().to_vector())


@every_kind
def test_what_it_cannot_do_is_one_line(robot: str, task: str):
    config = make_config(robot, task)
    spec = env_spec(config)
    noisy = (Condition("noise", joint_noise=0.01),)
    if "varied" in spec.can:
        assert make_env(config, None, noisy)
    else:
        with pytest.raises(UsageError, match=f"^{robot} cannot be varied; leave out noise$"):
            make_env(config, None, noisy)
    if not spec.all_cameras:
        with pytest.raises(UsageError, match=f"^{robot} cannot be drawn; omit --cameras=front$"):
            env_spec(config, CameraConfig(("front",)))


def test_of_several_tasks_an_episode_has_one_and_is_the_same_as_alone():
    config = make_config(*SEVERAL)
    env, names = make_env(config), task_names(config)
    seeds = stream_seeds("training", 6)
    texts = set()
    for seed in seeds:
        number = task_number(seed, len(names))
        alone = make_config("panda", str(names[number]), horizon=config.horizon)
        other = make_env(alone)
        env.start(seed)
        other.start(seed)
        seen, theirs = env.observe(), other.observe()
        found = dict(zip(env.spec.environment_state_names, seen.environment_state, strict=True))
        own = dict(zip(other.spec.environment_state_names, theirs.environment_state, strict=True))
        lacking = found.keys() - own.keys()
        assert own.items() <= found.items()
        assert not any(found[name] for name in lacking if not name.startswith(PRESENT))
        for name in (one for one in found if one.startswith(PRESENT)):
            assert found[name] == (name.removeprefix(PRESENT) in own)
        label = make_expert(config).label(env.get_state(), env)
        theirs_label = make_expert(alone).label(other.get_state())
        assert np.array_equal(label.action, theirs_label.action)
        assert env.spec.phases[label.phase] == other.spec.phases[theirs_label.phase]
        assert env.step(label.action)[1:] == other.step(label.action)[1:]
        texts.add(seen.instruction)
    assert len(texts) == len(names)


def test_tasks_and_conditions_that_take_turns_meet_each_other():
    met = {(task_number(seed, 4), seed % 2) for seed in range(1000, 1032)}
    assert met == {(task, condition) for task in range(4) for condition in range(2)}


def test_episodes_are_divided_in_proportion():
    assert divide(10, [1, 1, 1]) == [4, 3, 3]
    assert divide(9, [0.5, 1, 3]) == [1, 2, 6]


def test_numbers_of_a_task_have_commas_too():
    assert tasks_in("lift,carry:dirt=1,far=0.5,lift") == ("lift", "carry:dirt=1,far=0.5")
    assert len(task_names(make_config("metaworld", "easy,peg-insert-side-v3"))) == 29


def test_what_only_an_environment_has_is_neither_stored_nor_compared():
    spec = env_spec(make_config())
    bare = dataclasses.replace(
        spec, can=(), horizon=0, all_cameras=(), default_cameras=(), points=()
    )
    assert (bare, bare.to_json()) == (spec, spec.to_json())
