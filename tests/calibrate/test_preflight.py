"""Faults between a policy and a recording of an arm are named, and sound recordings pass."""

import io
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from manip_il.calibrate.preflight import Preflight
from manip_il.calibrate.servos import to_angles
from manip_il.cli.main import main
from manip_il.data.dataset import Dataset, EpisodeData
from manip_il.data.lerobot_write import write_episodes
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import F64
from manip_il.robots.table import get_robot
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.worlds.ladder.world import LadderEnv, scene_of
from manip_il.worlds.table import make_config

pytestmark = pytest.mark.gl
CAMERAS, SIDE, FRAMES = ("front", "wrist"), 96, 6
ROBOT = get_robot("so101")
BUMPED = Condition(
    "bumped",
    camera_shift=(0, 0.01),
    camera_turn=(0, 3),
    brightness=(0.6, 1.4),
    light_turn=(-60, 60),
)
SOUND = 20  # recordings


@dataclass(frozen=True)
class Recorded:
    """A recording of an arm at rest: joints (n,), and a picture of each camera."""

    state: F64
    seen: dict[str, np.ndarray]
    names: tuple[str, ...] = ROBOT.joint_names
    fps: int = 30

    def write(self, root: Path) -> Path:
        """Write it as lerobot-record does, with the noise of a camera."""
        rng = np.random.default_rng(int(abs(self.state[0]) * 1e6))
        states = self.state + rng.normal(0, 0.05, (FRAMES, len(self.state)))
        column = {"dtype": "float32", "shape": [len(self.names)], "names": list(self.names)}
        features: dict[str, Any] = dict.fromkeys(("observation.state", "action"), column)
        columns = dict.fromkeys(features, states.astype(np.float32))
        for camera, picture in self.seen.items():
            key = f"observation.images.{camera}"
            axes = ["height", "width", "channels"]
            features[key] = {"dtype": "video", "shape": picture.shape, "names": axes}
            columns[key] = np.stack([photographed(picture, rng) for _ in range(FRAMES)])
        rest = EpisodeData(columns, ["rest"] * FRAMES)
        write_episodes([rest], root, features, self.fps, "so_follower")
        return root


def photographed(picture: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return a picture with noise, through JPEG."""
    noisy = (picture + rng.normal(0, 6, picture.shape)).clip(0, 255).astype(np.uint8)
    stream = io.BytesIO()
    Image.fromarray(noisy).save(stream, "JPEG", quality=int(rng.integers(60, 95)))
    return np.asarray(Image.open(stream))


@pytest.fixture(scope="module")
def policy(tmp_path_factory: pytest.TempPathFactory) -> LearnedPolicy:
    folder = tmp_path_factory.mktemp("policy")
    size = [f"--image.height={SIDE}", f"--image.width={SIDE}", f"--cameras={','.join(CAMERAS)}"]
    demos = f"--dataset.root={folder / 'demos'}"
    task = ["--robot.type=so101", "--task.type=lift", "--dataset.num_episodes=4", "--workers=1"]
    assert main(["record", demos, *task, *size]) == 0
    fit = ["--policy.type=cnn", "--steps=2", "--batch_size=4"]
    assert main(["train", demos, *fit, f"--output_dir={folder / 'run'}"]) == 0
    return LearnedPolicy.load(folder / "run")


@pytest.fixture(scope="module")
def sound() -> list[Recorded]:
    return recordings(range(1000), SOUND)


def recordings(seeds: Iterable[int], count: int) -> list[Recorded]:
    """Return recordings of the virtual arm where episodes start, its cameras and lights slightly
    moved, and its gripper about a quarter open.
    """
    cameras = CameraConfig(CAMERAS, SIDE, SIDE)
    env = LadderEnv(make_config("so101", "lift"), cameras, [BUMPED])
    found: list[Recorded] = []
    for seed in seeds:
        env.start(seed)
        if len(found) < count and 12 < env.world.measured[-1] < 35:
            seen = env.observe()
            found.append(Recorded(seen.state.astype(float), dict(seen.images)))
    return found


def found(policy: LearnedPolicy, root: Path, limit: float = 15.0) -> list[str]:
    """Return the findings of a recording."""
    dataset = Dataset.open(root)
    preflight = Preflight(dataset, policy, scene_of("so101", "reach"), limit)
    return [str(finding) for finding in preflight.check(dataset)]


def with_pictures(change: Callable[[dict[str, Any]], dict[str, Any]]) -> Any:
    return lambda one: replace(one, seen=change(one.seen))


def with_joint(joint: int, change: Callable[[float], float]) -> Any:
    def changed(one: Recorded) -> Recorded:
        state = one.state.copy()
        state[joint] = change(state[joint])
        return replace(one, state=state)

    return changed


def resized(*size: int) -> Any:
    return with_pictures(
        lambda seen: {
            name: np.asarray(Image.fromarray(one).resize(size)) for name, one in seen.items()
        }
    )


def renamed(**names: str) -> Any:
    return with_pictures(
        lambda seen: {names.get(name, name): picture for name, picture in seen.items()}
    )


def in_radians(one: Recorded) -> Recorded:
    return replace(one, state=to_angles(ROBOT, one.state[None])[0])


def gripper_in_radians(one: Recorded) -> Recorded:
    return replace(one, state=np.append(one.state[:-1], in_radians(one).state[-1]))


def reordered(one: Recorded) -> Recorded:
    order = [0, 1, 2, 4, 3, 5]
    return replace(one, state=one.state[order], names=tuple(one.names[place] for place in order))


PLANTED: list[tuple[Any, str]] = [
    (renamed(front="top"), "name it front"),
    (renamed(wrist="hand"), "name it wrist"),
    (renamed(front="one", wrist="two"), "one is recorded, and the policy reads front"),
    (with_pictures(lambda seen: {"front": seen["front"]}), "add the camera"),
    (renamed(front="wrist", wrist="front"), "shows what wrist should see"),
    (resized(64, 48), "pictures of 64x48"),
    (resized(48, 48), "pictures of 48x48"),
    (lambda one: replace(one, fps=15), "15 frames a second"),
    (lambda one: replace(one, fps=60), "60 frames a second"),
    (with_pictures(lambda seen: {k: v[..., ::-1] for k, v in seen.items()}), "red and blue"),
    (with_pictures(lambda seen: seen | {"wrist": seen["wrist"][..., ::-1]}), "red and blue"),
    (in_radians, "in radians, and the policy reads degrees"),
    (with_joint(4, lambda angle: angle + 360), "off by +1 turn"),
    (with_joint(0, lambda angle: angle - 360), "off by -1 turn"),
    (with_joint(2, lambda angle: angle + 80), "elbow_flex.pos is at"),
    (with_joint(5, lambda opening: 100 - opening), "reversed"),
    (with_joint(5, lambda opening: opening / 100), "gripper.pos is in radians or from 0 to 1"),
    (gripper_in_radians, "gripper.pos is in radians or from 0 to 1"),
    (lambda one: replace(one, names=tuple(n[:-4] for n in one.names)), "names of the joints"),
    (reordered, "order of the joints"),
    (with_pictures(lambda seen: seen | {"wrist": 0 * seen["wrist"]}), "nothing is seen"),
]


@pytest.mark.parametrize(("fault", "named"), PLANTED)
def test_a_planted_fault_is_named(policy, sound, tmp_path, fault, named):
    recorded = sound[PLANTED.index((fault, named)) % SOUND]
    lines = found(policy, fault(recorded).write(tmp_path / "rest"))
    assert any(named in line for line in lines), lines


def test_sound_recordings_pass(policy, sound, tmp_path):
    roots = [one.write(tmp_path / str(number)) for number, one in enumerate(sound)]
    alarms = [*filter(None, (found(policy, root) for root in roots))]
    assert len(alarms) <= 1, alarms


def test_a_far_first_target_is_named(policy, sound, tmp_path):
    [line] = found(policy, sound[0].write(tmp_path / "rest"), limit=0.01)
    assert "max_relative_target=0.01" in line
