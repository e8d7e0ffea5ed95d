"""How well `robot align` finds the cameras and zeros of hidden arms.

Usage: python benchmarks/align.py [--seed=0] [--arms=20] [--rests=50] [--play=0]

Each arm is a virtual SO-101 whose cameras stand elsewhere than the nominal ones (the fixed one by
up to 5 cm, the one on the hand by up to 1.5 cm, both by up to 5 degrees, focal lengths by up to
10 %), with distorted lenses and zeros off by up to 2 degrees. A board lies at four places; the arm
rests in random postures, and its encoders have their own steps. `--play` adds backlash [degrees].
Pictures of 640 x 480 are drawn, distorted, blurred, made noisy and stored as JPEG.

Prints the median error of the fingertips in the fixed camera's frame and of a point of the table,
located by the fixed camera, in the wrist camera's frame; and how many of the true values are in
their 95 % intervals. Values are compared with the pan's and the roll's zero as `align` holds them.

This file is also a task: `manip-il serve --task.type=benchmarks/align.py` has the board on the
table, at another place in every world, and `--robot.type=` may name a YAML with other cameras and
zeros.
"""

import argparse
import math
import tempfile
import time
from collections import Counter
from dataclasses import dataclass
from pathlib import Path
from typing import Any, override

import cv2
import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from manip_il.calibrate.align import Aligned, HandPoses, align
from manip_il.calibrate.align_page import camera_lines
from manip_il.calibrate.board import SQUARE, SQUARES, drawn
from manip_il.calibrate.sightings import Sightings, look
from manip_il.mdp import F64
from manip_il.robots.table import get_robot
from manip_il.sim import render
from manip_il.sim.config import CameraConfig
from manip_il.sim.scene import Scene, build_scene, camera_id
from manip_il.sim.task import Start
from manip_il.sim.world import GOAL, World
from manip_il.tasks.pick_place import ReachGoal

SIZE = 640, 480
FIXED, WRIST = "front", "wrist"
PLACES = 4
TIP = np.zeros(3)  # in the frame `ee` [m]
ENCODER = 2 * math.pi / 4096  # [rad]
SPREAD = np.array([1.0, 0.7, 0.7, 0.8, 1.2])  # of postures around home [rad]
LOWEST = 0.04  # of the fingertips [m]
BLUR, NOISE, QUALITY = 0.7, 2.0, 90  # [pixel], [of 255], of JPEG
MARGIN = 0.009  # white edge of the board [m]


class Board(ReachGoal):
    """A board on the table, at another place in every world."""

    name = "board"
    instruction = "Look at the board."

    @override
    def build(self, spec: mujoco.MjSpec) -> None:
        super().build(spec)
        edge = round(MARGIN / SQUARE * drawn().shape[1] / SQUARES[0])
        picture = np.pad(drawn(), edge, constant_values=255)
        texture = spec.add_texture(
            name="board",
            type=mujoco.mjtTexture.mjTEXTURE_2D,
            nchannel=3,
            height=picture.shape[0],
            width=picture.shape[1],
        )
        texture.data = np.repeat(picture[:, :, None], 3, axis=2).tobytes()
        material = spec.add_material(name="board", specular=0.0)
        material.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "board"
        body = spec.worldbody.add_body(name="board", mocap=True, pos=[0.23, 0, 0])
        half = [count * SQUARE / 2 + MARGIN for count in SQUARES]
        body.add_geom(
            name="board",
            type=mujoco.mjtGeom.mjGEOM_BOX,
            size=[*half, 0.0002],
            material="board",
            contype=0,
            conaffinity=0,
            pos=[0, 0, 0.0001],
        )

    @override
    def draw(self, rng: np.random.Generator, world: World) -> Start:
        place = np.array([rng.uniform(0.2, 0.28), rng.uniform(-0.12, 0.12), 0.0])
        yaw = rng.uniform(-np.pi, np.pi) / 2
        turn = np.array([math.cos(yaw), 0, 0, math.sin(yaw)])
        below = np.array([0.5, 0.0, -1.0])  # a goal that is not shown
        return Start({GOAL: (below, np.array([1.0, 0, 0, 0])), "board": (place, turn)})


@dataclass(frozen=True)
class Truth:
    """A hidden arm.

    Attributes:
        lenses: Its cameras by name, as in `Aligned`, (9,).
        zeros: Its zeros, (arm,) [rad].
    """

    lenses: dict[str, F64]
    zeros: F64


def nominal(scene: Scene) -> dict[str, F64]:
    """Return the lenses of a scene's cameras."""
    data = mujoco.MjData(scene.model)
    mujoco.mj_forward(scene.model, data)
    found: dict[str, F64] = {}
    for name in (FIXED, WRIST):
        number = camera_id(scene.model, name)
        position = data.cam_xpos[number]
        rotation = data.cam_xmat[number].reshape(3, 3) * [1, -1, -1]
        if name == WRIST:
            site = data.site_xmat[scene.ee_site].reshape(3, 3).T
            position, rotation = site @ (position - data.site_xpos[scene.ee_site]), site @ rotation
        half = math.radians(scene.model.cam_fovy[number]) / 2
        focal = SIZE[1] / 2 / math.tan(half)
        turn = Rotation.from_matrix(rotation).as_rotvec()
        found[name] = np.array([*turn, *position, math.log(focal), 0, 0])
    return found


def hide(lenses: dict[str, F64], rng: np.random.Generator) -> Truth:
    """Draw a hidden arm around nominal lenses."""
    hidden: dict[str, F64] = {}
    for name, lens in lenses.items():
        turn = Rotation.from_rotvec(lens[:3]) * Rotation.from_rotvec(
            np.radians(rng.uniform(-5, 5, 3))
        )
        moved = rng.uniform(-0.05, 0.05, 3) * (0.3 if name == WRIST else 1.0)
        focal = lens[6] + math.log(1 + rng.uniform(-0.1, 0.1))
        bent = rng.uniform(-0.05, 0.05, 2)
        hidden[name] = np.array([*turn.as_rotvec(), *(lens[3:6] + moved), focal, *bent])
    return Truth(hidden, np.radians(rng.uniform(-2, 2, 5)))


def yaml_of(truth: Truth) -> str:
    """Return the YAML of a hidden arm, for `view` or `serve`."""
    lines = ["extends: so101", "cameras:"]
    for name, lens in truth.lenses.items():
        lines += camera_lines(name, lens, SIZE[1])
    return "\n".join(lines) + "\n"


def photograph(picture: Any, lens: F64, rng: np.random.Generator) -> Any:
    """Return what a real camera makes of a drawn picture."""
    width, height = SIZE
    focal = math.exp(lens[6])
    matrix = np.array([[focal, 0, width / 2], [0, focal, height / 2], [0, 0, 1]])
    grid = np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1) + 0.5
    bent = np.array([*lens[7:], 0, 0])
    plain = cv2.undistortPoints(grid.reshape(-1, 1, 2), matrix, bent, P=matrix)
    places = (plain.reshape(height, width, 2) - 0.5).astype(np.float32)
    seen = cv2.remap(picture, places, None, cv2.INTER_CUBIC)  # pyright: ignore
    seen = cv2.GaussianBlur(seen, (0, 0), BLUR) + rng.normal(0, NOISE, seen.shape)
    stored = cv2.imencode(
        ".jpg", np.clip(seen, 0, 255).astype(np.uint8), [cv2.IMWRITE_JPEG_QUALITY, QUALITY]
    )[1]
    return cv2.imdecode(stored, cv2.IMREAD_COLOR)


def record(truth: Truth, rests: int, play: float, rng: np.random.Generator) -> Sightings:
    """Draw the pictures of a hidden arm and find the board in them."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "hidden.yaml"
        path.write_text(yaml_of(truth))
        scene = build_scene(get_robot(path), Board())
    world, data = World(scene), mujoco.MjData(scene.model)
    mocap = scene.model.body_mocapid[scene.model.body("board").id]
    names = [FIXED, WRIST]
    found = Sightings(dict.fromkeys(names, SIZE), [], Counter())
    home = np.array(scene.robot.home)
    low, high = scene.model.jnt_range[: len(home)].T
    for place in range(PLACES):
        position, turn = scene.task.draw(rng, world).poses["board"]
        data.mocap_pos[:] = [0.5, 0.0, -1.0]  # a goal that is not shown
        data.mocap_pos[mocap], data.mocap_quat[mocap] = position, turn
        for row in range(10_000):
            done = sum(one.camera == WRIST and one.place == place for one in found.used)
            if done >= -(-rests // PLACES):
                break
            data.qpos[scene.arm_q] = q = np.clip(
                home + rng.uniform(-1, 1, len(home)) * SPREAD, low, high
            )
            mujoco.mj_forward(scene.model, data)
            if data.site_xpos[scene.ee_site][2] < LOWEST or not _sees(scene, data, position):
                continue
            error = math.radians(play) / 2 * rng.uniform(-1, 1, len(home))
            encoder = ENCODER * np.round((q - truth.zeros + error) / ENCODER)
            drawn_now = render.pictures(scene, data, CameraConfig((FIXED, WRIST), SIZE[1], SIZE[0]))
            for name in (WRIST, FIXED):
                seen, _ = look(
                    photograph(drawn_now[name], truth.lenses[name], rng),
                    100.0,
                    (name, place, row),
                    encoder,
                )
                if isinstance(seen, str):
                    found.thrown[name, seen] += 1
                else:
                    found.used.append(seen)
    return found


def _sees(scene: Scene, data: mujoco.MjData, place: F64) -> bool:
    """Whether the wrist camera looks at the board's middle."""
    number = camera_id(scene.model, WRIST)
    x, y, z = (place - data.cam_xpos[number]) @ data.cam_xmat[number].reshape(3, 3)
    half = -z * math.tan(math.radians(scene.model.cam_fovy[number]) / 2)
    return z < -0.05 and abs(y) < half and abs(x) < half


def pose(lens: F64) -> F64:
    """Return the pose of a camera, (4, 4)."""
    found = np.eye(4)
    found[:3, :3], found[:3, 3] = Rotation.from_rotvec(lens[:3]).as_matrix(), lens[3:6]
    return found


def hand_pose(hand: HandPoses, joints: F64) -> F64:
    """Return the pose of `ee`, (4, 4)."""
    found = np.eye(4)
    found[:3, 3], found[:3, :3] = hand.pose(joints)
    return found


def errors(truth: Truth, found: Aligned, rng: np.random.Generator) -> tuple[float, float]:
    """Return median errors of fingertips and of a point of the table [m]."""
    robot = get_robot("so101")
    hand, home = HandPoses(robot), np.array(robot.home)
    lenses = dict(zip(found.names, found.lenses, strict=True))
    tips: list[float] = []
    points: list[float] = []
    true_fixed, our_fixed = (np.linalg.inv(pose(one[FIXED])) for one in (truth.lenses, lenses))
    for _ in range(200):
        encoder = home + rng.uniform(-1, 1, len(home)) * SPREAD * 0.8
        true_hand, our_hand = (hand_pose(hand, encoder + one.zeros) for one in (truth, found))
        tip = np.array([*TIP, 1.0])
        tips.append(
            float(np.linalg.norm(true_fixed @ true_hand @ tip - our_fixed @ our_hand @ tip))
        )
        point = np.array([*true_hand[:2, 3], 0, 1])
        ours = np.linalg.inv(our_fixed) @ true_fixed @ point
        true_wrist, our_wrist = (
            true_hand @ pose(truth.lenses[WRIST]),
            our_hand @ pose(lenses[WRIST]),
        )
        seen = np.linalg.inv(true_wrist) @ point - np.linalg.inv(our_wrist) @ ours
        points.append(float(np.linalg.norm(seen)))
    return float(np.median(tips)), float(np.median(points))


def scores(truth: Truth, found: Aligned) -> F64:
    """Return the errors of all that is told, in standard deviations."""
    hand = HandPoses(get_robot("so101"))
    held = truth.zeros * [0, 1, 1, 1, 0]
    # the same arm with the pan's and the roll's zero in its cameras' poses
    around = hand_pose(hand, truth.zeros * [1, 1, 1, 1, 0]) @ np.linalg.inv(hand_pose(hand, held))
    mount = np.linalg.inv(hand_pose(hand, held)) @ hand_pose(hand, truth.zeros * [0, 1, 1, 1, 1])
    moved = {FIXED: np.linalg.inv(around), WRIST: mount}
    told = np.isfinite(found.zero_deviations)
    ratios = [((found.zeros - held) / found.zero_deviations)[told]]
    for name, lens, deviation in zip(found.names, found.lenses, found.lens_deviations, strict=True):
        there = moved[name] @ pose(truth.lenses[name])
        turn = Rotation.from_matrix(there[:3, :3]).as_rotvec()
        angle = np.linalg.norm(turn)
        turn = min(
            turn, turn * (1 - 2 * np.pi / angle), key=lambda one: np.abs(one - lens[:3]).sum()
        )
        true = np.array([*turn, *there[:3, 3], *truth.lenses[name][6:]])
        ratios.append((lens - true) / deviation)
    return np.concatenate(ratios)


def main() -> None:
    """Print a line an arm, and the summary."""
    reader = argparse.ArgumentParser()
    reader.add_argument("--seed", type=int, default=0)
    reader.add_argument("--arms", type=int, default=20)
    reader.add_argument("--rests", type=int, default=50)
    reader.add_argument("--play", type=float, default=0.0)
    given = reader.parse_args()
    robot = get_robot("so101")
    lenses = nominal(build_scene(robot, Board()))
    rows: list[tuple[float, float]] = []
    every: list[F64] = []
    for seed in range(given.seed, given.seed + given.arms):
        rng = np.random.default_rng(seed)
        truth = hide(lenses, rng)
        begun = time.perf_counter()
        seen = record(truth, given.rests, given.play, rng)
        drew = time.perf_counter()

        found = align(robot, seen, "the benchmark")
        fitted = time.perf_counter() - drew
        tips, points = errors(truth, found, rng)
        ratios = scores(truth, found)
        inside = (np.abs(ratios) < 1.96).mean()
        print(
            f"arm {seed}: fingertips {1e3 * tips:.2f} mm, table {1e3 * points:.2f} mm, inside"
            f" {100 * inside:.0f} %, {len(seen.used)} sightings, {drew - begun:.0f} s drawn,"
            f" {fitted:.0f} s fitted, zeros off"
            f" {np.degrees(found.zeros - truth.zeros)[1:-1].round(2)} deg, encoder"
            f" {np.degrees(found.encoder):.3f} deg",
            flush=True,
        )
        rows.append((tips, points))
        every.append(ratios)
    best = 1e3 * np.array(rows)
    ratios = np.concatenate(every)
    print(
        f"median {np.median(best, 0).round(2)} mm, worst {best.max(0).round(2)} mm;"
        f" {(np.abs(ratios) < 1.96).mean() * 100:.0f} % of {len(ratios)} values inside"
    )


if __name__ == "__main__":
    main()
