"""Whether a policy and a real arm fit together, from a few recorded seconds of the arm at rest.

Recorded pictures are compared with pictures drawn at the recorded joints: with the joints as they
are, and as they would be with a fault (cameras swapped, colours exchanged, the gripper reversed). A
fault is reported if the pictures agree better with it. Nothing moves.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import combinations

import mujoco
import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.bridges.doctor.files import Finding
from manip_il.calibrate.servos import in_units, to_angles
from manip_il.data.dataset import Dataset
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.evaluation.report import Figure, drawing, to_figure
from manip_il.learn.names import CNN
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import F64
from manip_il.sim.config import CAMERAS, CameraConfig
from manip_il.sim.render import Picture, pictures
from manip_il.sim.world import Scene

Mask = NDArray[np.bool_]
_SIDE = (32, 32)  # of the reduced pictures that are compared [pixels]
_BETTER = 0.3  # how much better a fault must explain the pictures, as a difference of correlations,
_NEARER = 1.1  # or the gripper, as the logarithm of a ratio of errors
_PLAIN = 3.0  # standard deviation of the pixels below which a picture shows nothing, of 255
_CHANGED = 20.0  # least change of a pixel that shows the gripper's opening, of 255
_PIXELS = 10  # fewer such pixels tell nothing
_COLOURED = 0.4  # share of the strongest colour from which a pixel counts as coloured
_BEYOND = 0.1  # tolerated distance from the training range, as a share of it,
_LEAST = 5.0  # but at least so much [deg, %]
_RATE = 0.05  # tolerated difference of rates
_PANEL = (3.2, 2.6)  # a picture on the page [inches]
_START = "put the arm where training episodes start, or calibrate it again: lerobot-calibrate"


@dataclass(frozen=True)
class Preflight:
    """A recording of an arm at rest, and the policy that is to drive the arm.

    Attributes:
        dataset: The recording, made by lerobot-record.
        policy: The policy.
        scene: The simulated arm, alone.
        limit: The arm's `max_relative_target` [deg].
    """

    dataset: Dataset
    policy: LearnedPolicy
    scene: Scene
    limit: float

    @cached_property
    def state(self) -> F64:
        """The recorded joints in the middle [deg], the gripper's from 0 to 100, (n,)."""
        return self.dataset.columns([STATE])[STATE][len(self.dataset) // 2].astype(float)

    @cached_property
    def seen(self) -> dict[str, Picture]:
        """The picture of each camera in the same frame, (height, width, 3)."""
        middle = np.array([len(self.dataset) // 2])
        keys = [key for key in self.dataset.cameras if self.dataset.features[key].is_rgb]
        return {key.removeprefix(IMAGES): self.dataset.frames(key, middle)[0] for key in keys}

    @cached_property
    def drawn(self) -> dict[str, Picture]:
        """What the simulated cameras see at the recorded joints, (height, width, 3)."""
        return self._draw(self.state)

    def _draw(self, state: F64) -> dict[str, Picture]:
        read = self.policy.checkpoint.pictures
        names = tuple(name for name in read if name in CAMERAS)
        if not names:
            return {}
        data = mujoco.MjData(self.scene.model)
        data.mocap_pos[:, 2] = -9.0  # move goals out of sight
        joints = np.append(self.scene.arm_q, self.scene.gripper.q)
        data.qpos[joints] = to_angles(self.scene.robot, state[None])[0]
        mujoco.mj_forward(self.scene.model, data)
        return pictures(self.scene, data, CameraConfig(names, *read[names[0]]))

    def check(self, _: Dataset) -> Iterator[Finding]:
        """Yield what is wrong, up to the first kind of fault that others would follow from."""
        yield from self._check_rate()
        for check in (
            self._check_columns,
            self._check_arm,
            self._check_cameras,
            self._check_views,
            self._check_gripper,
            self._check_target,
        ):
            found = [*check()]
            yield from found
            if found:
                return

    def _check_rate(self) -> Iterator[Finding]:
        origin, fps = self.policy.checkpoint.origin, self.dataset.fps
        if origin and abs(fps / origin.fps - 1) > _RATE:
            yield Finding(
                "fps",
                f"{fps:g} frames a second, and the policy acts {origin.fps:g} times a second",
                f"record with --dataset.fps={origin.fps:g}, roll out with --fps={origin.fps:g}",
            )

    def _check_columns(self) -> Iterator[Finding]:
        checkpoint, features = self.policy.checkpoint, self.dataset.features
        if ENVIRONMENT_STATE in checkpoint.numbers:
            text = "the policy reads it, and no real arm measures it"
            yield Finding(ENVIRONMENT_STATE, text, "train with --observation=images")
        origin = checkpoint.origin or self.scene.robot
        wanted = origin.joint_names
        for key in (STATE, ACTION):
            found = features[key].labels if key in features else ()
            if found != wanted:
                what = "order" if sorted(found) == sorted(wanted) else "names"
                yield Finding(
                    key,
                    f"{what} of the joints: {', '.join(found)}; the policy has {', '.join(wanted)}",
                    "record with LeRobot's driver of the arm that the policy is for",
                )

    def _distances(self, state: F64) -> F64:
        """Return how far joints (n,) are outside the training data, as multiples of what is
        tolerated, (n,).
        """
        low, high = self.policy.checkpoint.state_range
        away = np.maximum(low - state, state - high)
        return away / np.maximum(_BEYOND * (high - low), _LEAST)

    def _check_arm(self) -> Iterator[Finding]:
        """Check units and ranges of all joints but the gripper."""
        arm, turned = self.state[:-1], np.degrees(self.state)
        here, there = (self._distances(one)[:-1] for one in (self.state, turned))
        if np.abs(arm).max() <= np.pi and here.max() > 1 and there.max() < here.max():
            text = "joints are in radians, and the policy reads degrees"
            yield Finding(STATE, text, "set --robot.use_degrees=true")
            return
        low, high = self.policy.checkpoint.state_range
        turns = np.round((self.state - (low + high) / 2) / 360)
        wraps = self._distances(self.state - 360 * turns) <= 1
        for joint in np.flatnonzero(here > 1):
            off = f"off by {turns[joint]:+.0f} turn" if turns[joint] and wraps[joint] else ""
            yield self._out_of_range(int(joint), off)

    def _out_of_range(self, joint: int, likely: str) -> Finding:
        low, high = (end[joint] for end in self.policy.checkpoint.state_range)
        name, value = self.scene.robot.joint_names[joint], self.state[joint]
        text = f"{name} is at {value:.3g}, and the policy was trained on {low:.0f} to {high:.0f}"
        return Finding(STATE, text + (likely and f": {likely}"), _START)

    def _check_cameras(self) -> Iterator[Finding]:
        """Check that the policy's cameras are there, with pictures that it can read."""
        read = self.policy.checkpoint.pictures
        spare = [name for name in self.seen if name not in read]
        for name, (height, width) in read.items():
            if name not in self.seen:
                likely = max(spare, key=partial(self._agreement, drawn=name), default="")
                spare = [other for other in spare if other != likely]
                text = f"{likely or 'no other camera'} is recorded, and the policy reads {name}"
                remedy = f"name it {name} in --robot.cameras" if likely else "add the camera"
                yield Finding(IMAGES + name, text, remedy)
                continue
            if _shrink(self.seen[name]).std() < _PLAIN:
                yield Finding(IMAGES + name, "nothing is seen", "uncover and light the camera")
                continue
            high, wide = self.seen[name].shape[:2]
            # the cnn reduces larger pictures itself
            fits = high * width == wide * height and high >= height
            if (high, wide) != (height, width) and not (
                fits and self.policy.checkpoint.kind == CNN
            ):
                text = f"pictures of {wide}x{high} pixels, and the policy reads {width}x{height}"
                remedy = f"set width: {width}, height: {height} in --robot.cameras"
                yield Finding(IMAGES + name, text, remedy)

    def _agreement(self, seen: str, drawn: str) -> float:
        """Return the correlation of a recorded picture's edges with those of a drawn one."""
        if drawn not in self.drawn:
            return 0.0
        there = np.ones(_SIDE, bool)
        return _correlate(_edges(self.seen[seen]), _edges(self.drawn[drawn]), there)

    def _check_views(self) -> Iterator[Finding]:
        """Check for swapped cameras and exchanged colours."""
        for one, other in combinations(self.drawn, 2):
            straight = self._agreement(one, one) + self._agreement(other, other)
            if self._agreement(one, other) + self._agreement(other, one) > straight + _BETTER:
                text = f"shows what {other} should see, and {other} what {one} should"
                yield Finding(IMAGES + one, text, "exchange the two in --robot.cameras")
                return
        for name, drawn in self.drawn.items():
            seen, wanted = (_colours(picture) for picture in (self.seen[name], drawn))
            strength = np.linalg.norm(wanted, axis=-1)
            there = strength > _COLOURED * strength.max()
            gain = _correlate(seen[..., ::-1], wanted, there) - _correlate(seen, wanted, there)
            if gain > _BETTER:
                remedy = "set color_mode: rgb in --robot.cameras, or mend what sends the pictures"
                yield Finding(IMAGES + name, "red and blue are exchanged", remedy)

    def _check_gripper(self) -> Iterator[Finding]:
        """Check direction and units of the gripper by the pictures, then its range."""
        at, name = self.state[-1], self.scene.robot.joint_names[-1]
        angle = in_units(self.scene.robot, self.state[None])[0, -1]
        units = "in radians or from 0 to 1, and the policy reads 0 to 100"
        meant = ((units, 100 * at), (units, angle), ("reversed, with 0 for open", 100 - at))
        known = [(text, other) for text, other in meant if not self._is_beyond(other)]
        likely = [text for text, other in known if self._gain(other) > _NEARER]
        if likely:
            yield Finding(STATE, f"{name} is {likely[0]}: so the pictures show it", _START)
        elif self._is_beyond(at):
            is_reversed = not self._is_beyond(100 - at)
            yield self._out_of_range(len(self.state) - 1, "reversed" if is_reversed else "")

    def _is_beyond(self, gripper: float) -> bool:
        """Return whether an opening of the gripper [%] is outside the training data."""
        return bool(self._distances(np.append(self.state[:-1], gripper))[-1] > 1)

    def _gain(self, gripper: float) -> float:
        """Return how much nearer the pictures are to another opening of the gripper, 0 to 100."""
        gain = 0.0
        for name, other in self._draw(np.append(self.state[:-1], gripper)).items():
            seen, *both = map(_shrink, (self.seen[name], self.drawn[name], other))
            changed = np.abs(both[0] - both[1]).max(axis=-1) > _CHANGED
            if changed.sum() >= _PIXELS:
                errors = (np.abs(seen - _recoloured(seen, one, ~changed))[changed] for one in both)
                here, there = (max(error.mean(), 1e-9) for error in errors)
                gain += 2 * float(np.log(here / there))
        return gain

    def _check_target(self) -> Iterator[Finding]:
        """Check how far the policy's first target is from the arm."""
        state = self.state[None].astype(np.float32)
        read = self.policy.checkpoint.pictures
        images = {name: _resized(self.seen[name], size)[None] for name, size in read.items()}
        target = self.policy.act(state, state[:, :0], images)
        away = np.abs(target - state)[0, :-1]  # a gripper may open or close at once
        joint = int(away.argmax())
        if away[joint] > self.limit:
            text = f"the first target of {self.scene.robot.joint_names[joint]} is"
            text += f" {away[joint]:.3g} degrees away, beyond max_relative_target={self.limit:g}"
            yield Finding(ACTION, text, f"look at the pictures, and {_START}")

    def figure(self) -> Figure | None:
        """Return the recorded pictures beside the simulated ones; None if there are none."""
        names = [name for name in self.drawn if name in self.seen]
        if not names:
            return None
        with drawing(2 * len(names), size=_PANEL) as (drawn, axes):
            for place, axis in enumerate(axes[0]):
                name, is_drawn = names[place // 2], place % 2
                axis.imshow((self.drawn if is_drawn else self.seen)[name])
                axis.set_title(f"{name}, {'simulated' if is_drawn else 'recorded'}")
                axis.axis("off")
            return to_figure(drawn, "What the cameras see, beside the simulated pictures")


def _resized(picture: Picture, size: tuple[int, int]) -> Picture:
    """Return a picture (h, w, 3) of another height and width."""
    height, width = size
    return np.array(Image.fromarray(picture).resize((width, height), Image.Resampling.BOX))


def _shrink(picture: Picture) -> F64:
    return _resized(picture, _SIDE).astype(float)


def _colours(picture: Picture) -> F64:
    """Return a small picture without its brightness, (32, 32, 3)."""
    small = _shrink(picture)
    return small - small.mean(axis=-1, keepdims=True)


def _edges(picture: Picture) -> F64:
    """Return how strong the edges of a small picture are, whatever its colours, (32, 32)."""
    slopes = np.gradient(_shrink(picture), axis=(0, 1))
    return np.linalg.norm(slopes, axis=(0, -1))


def _correlate(seen: F64, drawn: F64, where: Mask) -> float:
    """Return the correlation of two small pictures at some pixels (32, 32)."""
    return float(np.corrcoef(seen[where].ravel(), drawn[where].ravel())[0, 1])


def _recoloured(seen: F64, drawn: F64, where: Mask) -> F64:
    """Return a drawn picture (32, 32, 3) in the colours of a recorded one.

    Lights, table and arm may have other colours: an affine map of the colours that fits best at
    some pixels (32, 32) takes care of them.
    """
    terms = np.concatenate([drawn, np.full((*drawn.shape[:2], 1), 255.0)], axis=-1)
    colours, *_ = np.linalg.lstsq(terms[where], seen[where], rcond=None)
    return terms @ colours
