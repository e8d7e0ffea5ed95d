"""The script that times pictures draws every robot's with every camera, with ours and with MuJoCo's own renderer."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from manip_il.robots import ROBOTS
from manip_il.sim.config import CAMERAS

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "picture_speed.py"


@pytest.mark.slow
@pytest.mark.gl
def test_the_script_has_a_line_for_every_robot_and_camera():
    done = subprocess.run([sys.executable, SCRIPT, "--quick"], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    shown = {tuple(line.split()[:2]) for line in done.stdout.splitlines()}
    assert shown >= {(robot, camera) for robot in ROBOTS for camera in CAMERAS}
