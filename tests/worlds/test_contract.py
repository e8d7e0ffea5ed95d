"""The contract of a world, kept by each kind: what is named is there, and what it cannot do it
says in one line.
"""

import dataclasses

import numpy as np
import pytest

from manip_il.errors import UsageError
from manip_il.seeding import stream_seeds
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.world import EnvironmentSpec
from manip_il.worlds.config import WORLDS
from manip_il.worlds.table import env_spec, make_config, make_env, make_expert

KINDS = [("panda", "sort"), *((str(robot), world.tasks[-1]) for robot, world in WORLDS.items())]
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


def test_what_only_an_environment_has_is_neither_stored_nor_compared():
    spec = env_spec(make_config())
    bare = dataclasses.replace(
        spec, can=(), horizon=0, all_cameras=(), default_cameras=(), points=()
    )
    assert (bare, bare.to_json()) == (spec, spec.to_json())
