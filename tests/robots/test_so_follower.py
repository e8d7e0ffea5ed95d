"""SO-101 speaks as the real one does in LeRobot: its names, degrees, 0 to 100, 30 frames a
second.
"""

from typing import Any

import numpy as np
import pytest

from manip_il.data.schema import ACTION, LEROBOT_TYPES, STATE, features
from manip_il.lerobot_plugin import ManipILEnv
from manip_il.robots import ROBOTS
from manip_il.robots.table import get_robot
from manip_il.sim.config import CameraConfig
from manip_il.sim.env import ManipEnv
from manip_il.worlds.contract import SERVOS
from manip_il.worlds.ladder.world import scene_of
from manip_il.worlds.table import described_env, env_spec, make_config

from ..scenes import started
from ..so_follower import Camera, arm, recorders_features

JAW = "gripper"
STEP = 360 / 4096  # of a servo [deg]
OUT_OF_STEP = 1.01 * STEP


@pytest.fixture
def real(monkeypatch: pytest.MonkeyPatch) -> Any:
    return arm(monkeypatch, limits(), {"front": Camera(48, 64)})


def limits() -> dict[str, tuple[float, float]]:
    """Of the model's joints [rad], whose names are the servos'."""
    robot, model = get_robot("so101"), scene_of("so101", "reach").model
    return {name: tuple(model.joint(f"robot/{name}").range) for name in (*robot.joints, JAW)}


def stand(real: Any, env: ManipEnv) -> None:
    """Put the real arm's servos where the simulated joints are."""
    real.bus.stand({name: float(env.data.joint(f"robot/{name}").qpos[0]) for name in limits()})


def test_features_are_those_that_lerobots_recorder_makes(real):
    spec = env_spec(
        make_config("so101", "pick_place", object="box:0.025"), CameraConfig(("front",), 48, 64)
    )
    ours, theirs = features(spec), recorders_features(real)
    for key, feature in theirs.items():
        assert {**ours[key], "info": None} == {
            **feature,
            "shape": tuple(feature["shape"]),
            "info": None,
        }, key
    assert list(theirs) == [ACTION, STATE, "observation.images.front"]
    assert (spec.robot_type, spec.robot, spec.fps) == (real.name, "so101", 30)


def test_a_measured_state_is_what_the_real_arms_servos_read(real):
    env = started("so101", "pick_place", seed=3, object="box:0.025")
    rng, actions = np.random.default_rng(0), env.scene.actions
    for _ in range(20):
        env.advance(actions.random_near(env.world.measured, rng))
        stand(real, env)
        read = real.get_observation()
        ours = dict(zip(actions.names, env.world.measured.tolist(), strict=True))
        assert list(ours) == [name for name in read if name.endswith(".pos")]
        for name in ours:
            assert abs(ours[name] - read[name]) < OUT_OF_STEP, name


def test_the_real_arm_goes_where_an_action_sends_the_simulated_one(real):
    actions = described_env(make_config("so101", "reach")).actions
    rng = np.random.default_rng(0)
    for _ in range(20):
        action = rng.uniform(actions.low, actions.high)
        real.send_action(dict(zip(actions.names, action.tolist(), strict=True)))
        joints, opening = actions.split(action)
        wanted = [*joints, *scene_of("so101", "reach").gripper.command(opening)]
        steps = [real.bus.steps[name] for name in limits()]
        np.testing.assert_allclose(
            (np.array(steps) - 2047.5) * 360 / 4096, np.degrees(wanted), atol=2 * STEP
        )


def test_units_there_and_back_are_the_same_joints_and_opening():
    scene, rng = scene_of("so101", "reach"), np.random.default_rng(0)
    actions, gripper = scene.actions, scene.gripper
    for _ in range(50):
        joints, opening = rng.uniform(-1.5, 1.5, 5), rng.uniform(gripper.least, gripper.most)
        back, again = actions.split(actions.join(joints, opening))
        np.testing.assert_allclose(back, joints, atol=1e-12)
        assert again == pytest.approx(opening, abs=1e-9)
    closed = actions.join(np.zeros(5), gripper.least)
    assert closed[-1] == 0
    assert actions.join(np.zeros(5), gripper.most)[-1] == pytest.approx(
        100 * (1.2 + 0.1745) / 1.9199
    )
    # the simulated jaw opens to 72
    assert actions.clip(np.full(6, 100.0), 0)[-1] == actions.high[-1]


def test_robots_with_a_name_of_lerobots_are_known_by_it():
    named = {
        one.lerobot.robot_type: name
        for name in ROBOTS
        if (one := get_robot(name)).lerobot is not None
    }
    assert named == LEROBOT_TYPES
    assert {name: make_config(name).control_hz for name in ROBOTS} == {
        "panda": 20,
        "fetch": 20,
        "so101": 30,
    }
    assert env_spec(make_config("so101", "reach")).action_meaning == SERVOS
    assert ManipILEnv(task="Reach-v0", robot="so101").fps == 30
