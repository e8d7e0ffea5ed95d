"""What was aligned, as a robot's YAML and as a page."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from scipy.spatial.transform import Rotation

from manip_il.calibrate.align import ZERO, Aligned
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.evaluation.report import INTERVAL, Figure, Report, Section, Table, drawing, to_figure
from manip_il.mdp import F64
from manip_il.robots.robot import WRIST, CameraPose, Robot

_AHEAD = 0.3  # distance of the point that a camera's YAML looks at [m]
_TOLD = 0.5  # share of the prior's deviation below which the data tell a zero
_95 = 1.96  # half of a 95 % interval, in standard deviations
_PANEL = (4.2, 3.3)  # [inches]
_TURN = 4096 / 360  # steps of an encoder in a degree


def told(found: Aligned) -> list[bool]:
    """Return whether the pictures tell the zero of each joint of the arm."""
    return (found.zero_deviations < _TOLD * ZERO).tolist()


def fovy(lens: F64, height: int) -> float:
    """Return a camera's vertical field of view [deg].

    Args:
        lens: Its parameters, as in `Aligned`, (9,).
        height: Height of its pictures [pixels].
    """
    return math.degrees(2 * math.atan(height / 2 / math.exp(lens[6])))


def camera_lines(name: str, lens: F64, height: int) -> list[str]:
    """Return a camera's lines in a robot's YAML.

    Args:
        name: The camera.
        lens: Its parameters, as in `Aligned`, (9,).
        height: Height of its pictures [pixels].
    """
    rotation = Rotation.from_rotvec(lens[:3]).as_matrix()
    position = lens[3:6]
    target = position + _AHEAD * rotation[:, 2]
    level = CameraPose(tuple(position.tolist()), tuple(target.tolist())).quaternion
    axes = Rotation.from_matrix(rotation * [1, -1, -1])  # right, up, back
    roll = (Rotation.from_quat(level, scalar_first=True).inv() * axes).as_rotvec(degrees=True)[2]
    return [
        f"  {name}: # in the frame {'ee' if name == WRIST else 'of the base'}",
        f"    position: [{', '.join(f'{value:.5f}' for value in position)}] # [m]",
        f"    target: [{', '.join(f'{value:.5f}' for value in target)}] # [m]",
        f"    roll: {roll:.3f} # [deg]",
        f"    fovy: {fovy(lens, height):.3f} # [deg]",
    ]


def to_yaml(found: Aligned, robot: Robot, extends: str) -> str:
    """Return the YAML of a robot with these cameras and zeros.

    Args:
        found: What was aligned.
        robot: The robot without them.
        extends: The same, as `extends` names it.
    """
    lines = [f"extends: {extends}", "cameras: # made by manip-il robot align"]
    for name, lens in zip(found.names, found.lenses, strict=True):
        lines += camera_lines(name, lens, found.sizes[name][1])
    zeros = [
        f"  {joint}: {math.degrees(zero):.3f}"
        for joint, zero, is_told in zip(robot.plain_names, found.zeros, told(found), strict=False)
        if is_told
    ]
    return "\n".join([*lines, "zeros: # to add to the real arm's angles [deg]", *zeros]) + "\n"


def zero_table(found: Aligned, robot: Robot) -> Table:
    """Return a row a joint of the arm: what to add to its angles.

    Args:
        found: What was aligned.
        robot: The robot.
    """
    rows: list[tuple[str, ...]] = []
    for joint, zero, deviation, is_told in zip(
        robot.plain_names,
        np.degrees(found.zeros).tolist(),
        np.degrees(found.zero_deviations).tolist(),
        told(found),
        strict=False,
    ):
        interval = f"{zero:+.2f} [{zero - _95 * deviation:+.2f}, {zero + _95 * deviation:+.2f}]"
        steps = f"{-round(zero * _TURN):+d}"
        rows.append((joint, interval, steps) if is_told else (joint, "cannot be told", ""))
    return Table(
        ("joint", f"add to its angle [deg] {INTERVAL}", "homing_offset: add [steps]"), tuple(rows)
    )


def camera_table(found: Aligned) -> Table:
    """Return a row a camera, with half a 95 % interval."""
    rows: list[tuple[str, ...]] = []
    for name, lens, deviation in zip(
        found.names, found.lenses, _95 * found.lens_deviations, strict=True
    ):
        angle = fovy(lens, found.sizes[name][1])
        either = math.sin(math.radians(angle)) * math.degrees(deviation[6])
        at = ", ".join(f"{1e3 * value:.1f}" for value in lens[3:6])
        bent = (f"{lens[place]:.3f} ± {deviation[place]:.3f}" for place in (7, 8))
        rows.append(
            (
                name,
                f"({at}) ± {1e3 * deviation[3:6].max():.1f}",
                f"{np.degrees(deviation[:3]).max():.2f}",
                f"{angle:.2f} ± {either:.2f}",
                *bent,
            )
        )
    return Table(
        (
            "camera",
            "position [mm]",
            "direction ± [deg]",
            "vertical field of view [deg]",
            "k1",
            "k2",
        ),
        tuple(rows),
    )


def thrown_table(found: Aligned) -> Table:
    """Return a row a camera and reason: how many pictures were not used."""
    rows = ((name, why, str(count)) for (name, why), count in found.thrown.items() if count)
    return Table(("camera", "not used, because", "pictures"), tuple(rows))


def aligned_report(found: Aligned, robot: Robot, dataset: Dataset) -> Report:
    """Return the page: cameras, zeros, and each camera's picture that fits worst.

    Args:
        found: What was aligned.
        robot: The robot.
        dataset: The dataset with the pictures.
    """
    error = np.concatenate([_distances(found, number) for number in range(len(found.used))])
    return Report(
        title="Cameras and zeros, aligned",
        verdict=f"Corners of the board are seen within {error.mean():.2f} pixels of where the model"
        f" has them, on average, in {len(found.used)} pictures.",
        facts=untold(found, robot),
        sections=(
            Section("Zeros", tables=(zero_table(found, robot),)),
            Section("Cameras", tables=(camera_table(found),)),
            Section("Where it fits worst", figures=(_worst(found, dataset),)),
            Section("Pictures that were not used", tables=(thrown_table(found),)),
        ),
    )


def untold(found: Aligned, robot: Robot) -> tuple[str, ...]:
    """Return what the pictures cannot tell, in words.

    Args:
        found: What was aligned.
        robot: The robot.
    """
    first, *others, last = robot.plain_names[: len(robot.joints)]
    lines = [
        f"the zero of {first} cannot be told from the yaw of the base, nor that of {last} from the"
        " mount of the wrist camera; the cameras' poses are right for both as they are"
    ]
    loose = [joint for joint, is_told in zip(others, told(found)[1:-1], strict=True) if not is_told]
    if loose:
        lines.append(f"rest in more postures, in which {', '.join(loose)} differ")
    return tuple(lines)


def _distances(found: Aligned, number: int) -> F64:
    return np.linalg.norm(found.modelled[number] - found.used[number].pixels, axis=1)


def _worst(found: Aligned, dataset: Dataset) -> Figure:
    with drawing(len(found.names), size=_PANEL) as (drawn, axes):
        for axis, name in zip(axes[0], found.names, strict=True):
            numbers = [place for place, one in enumerate(found.used) if one.camera == name]
            worst = max(numbers, key=lambda number: _distances(found, number).mean())
            seen, modelled = found.used[worst], found.modelled[worst]
            [picture] = dataset.frames(s.IMAGES + name, np.array([seen.row]))
            height, width = picture.shape[:2]
            shown: Any = axis
            shown.imshow(picture, extent=(0, width, height, 0))
            shown.plot(*seen.pixels.T, "o", fillstyle="none", color="#d55e00", label="seen")
            shown.plot(*modelled.T, "+", color="#0072b2", label="modelled")
            error = _distances(found, worst).mean()
            shown.set(title=f"{name}, frame {seen.row}: {error:.2f} pixels", xticks=[], yticks=[])
            shown.grid(visible=False)
        axes[0][0].legend()
        return to_figure(drawn, "Corners of the board, as seen and as modelled")
