"""What was identified of an arm, as a robot's YAML and as a page."""

from __future__ import annotations

import numpy as np

from manip_il.calibrate.servos import Identified
from manip_il.evaluation.report import Figure, Report, Section, Table, drawing, to_figure
from manip_il.robots.servos import PARAMETERS

UNITS = ("N m/rad", "N m", "N m s/rad", "rad/s", "deg", "s", "N m", "kg m^2")
TELLS = (  # what motion would tell a parameter
    "a joint that holds a weight",
    "jumps of half a radian or more, or a weight",
    "fast swings",
    "jumps of a radian or more",
    "slow reversals, with the weight on either side",
    "jumps",
    "slow reversals",
    "fast swings",
)
_SHOWN = 6.0  # length of a joint's worst stretch [s]
_PANEL = (3.2, 2.4)  # [inches]


def to_yaml(found: Identified, robot: str) -> str:
    """Return the YAML of a robot with these servos: value and 95 % interval of each parameter.

    Args:
        found: The servos.
        robot: The robot without them, as `extends` names it.
    """
    lines = [f"extends: {robot}", "servos: # [value, low, high], made by manip-il robot identify"]
    for row, joint in enumerate(found.joints):
        lines.append(f"  {joint.removesuffix('.pos')}:")
        for column, name in enumerate(PARAMETERS):
            ends = (found.values, found.low, found.high)
            numbers = ", ".join(f"{end[row, column]:.5g}" for end in ends)
            untold = "" if found.told[row, column] else "; the dataset does not tell it"
            lines.append(f"    {name}: [{numbers}] # [{UNITS[column]}]{untold}")
    return "\n".join(lines) + "\n"


def servo_table(found: Identified) -> Table:
    """Return a row a joint: parameters with their intervals, and what stays unexplained."""

    def cell(row: int, column: int) -> str:
        if not found.told[row, column]:
            return "not told"
        interval = f"[{found.low[row, column]:.3g}, {found.high[row, column]:.3g}]"
        return f"{found.values[row, column]:.3g} {interval}"

    headers = (f"{name} [{unit}]" for name, unit in zip(PARAMETERS, UNITS, strict=True))
    rows = (
        (
            joint.removesuffix(".pos"),
            *(cell(row, column) for column in range(len(PARAMETERS))),
            f"{1e3 * found.error[row]:.1f}",
            f"{100 * found.unexplained[row]:.2f}",
        )
        for row, joint in enumerate(found.joints)
    )
    return Table(("joint", *headers, "error [mrad]", "unexplained [%]"), tuple(rows))


def advice(found: Identified) -> tuple[str, ...]:
    """Return a line for each parameter that a joint's motion does not tell, with what would."""
    lines: list[str] = []
    for column, name in enumerate(PARAMETERS):
        joints = [
            joint
            for joint, told in zip(found.joints, found.told[:, column], strict=True)
            if not told
        ]
        if joints:
            names = ", ".join(joint.removesuffix(".pos") for joint in joints)
            lines.append(
                f"{name} of {names} cannot be told from this dataset; {TELLS[column]} would"
            )
    return tuple(lines)


def identified_report(found: Identified, fps: float) -> Report:
    """Return the page: parameters, and the stretch of every joint that fits worst.

    Args:
        found: What was identified.
        fps: Frames per second of the dataset.
    """
    worst = found.joints[int(np.argmax(found.error))].removesuffix(".pos")
    error = 1e3 * found.error.mean()
    return Report(
        title="Servos, identified",
        verdict=f"The simulated arm follows the recorded one within {error:.1f} mrad on average;"
        f" {worst} fits worst.",
        facts=advice(found),
        sections=(
            Section("Parameters", tables=(servo_table(found),)),
            Section("Where it fits worst", figures=(_worst(found, fps),)),
        ),
    )


def _worst(found: Identified, fps: float) -> Figure:
    length = min(round(_SHOWN * fps), len(found.measured))
    with drawing(len(found.joints), size=_PANEL) as (drawn, axes):
        for row, (axis, joint) in enumerate(zip(axes[0], found.joints, strict=True)):
            measured, simulated = found.measured[:, row], found.simulated[:, row]
            sums = np.convolve(np.abs(measured - simulated), np.ones(length), "valid")
            start = int(np.argmax(sums))
            shown = slice(start, start + length)
            seconds = np.arange(length) / fps
            axis.plot(seconds, measured[shown], label="measured")
            axis.plot(seconds, simulated[shown], label="simulated", linestyle="--")
            axis.set(title=joint.removesuffix(".pos"), xlabel="time [s]")
        axes[0][0].set_ylabel("position [rad]")
        axes[0][0].legend()
        return to_figure(drawn, "Measured and simulated positions of every joint")
