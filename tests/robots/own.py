"""An arm of a user's own: one YAML and one MJCF, which brings a world of its own along as models
from outside do.
"""

from pathlib import Path
from typing import Any

import yaml

EXAMPLES = sorted((Path(__file__).parents[2] / "configs" / "robots").glob("*.yaml"))

# Five joints: turn, shoulder, elbow, wrist, and the hand's own turn. At zero it stands upright.
ARM = """
<mujoco model="own">
  <compiler angle="radian"/>
  <option timestep="0.004" gravity="0 0 -3"/>
  <size nuser_body="2" nuser_actuator="3"/>
  <visual><global offwidth="99"/><headlight ambient="0 0 0"/></visual>
  <statistic center="0 0 1" extent="9"/>
  <asset>
    <texture name="heaven" type="skybox" builtin="gradient" rgb1="1 0 0" rgb2="0 0 1" width="32" height="192"/>
    <material name="steel" rgba="0.5 0.5 0.5 1"/>
  </asset>
  <worldbody>
    <light name="lamp" pos="0 0 3"/>
    <camera name="eye" pos="1 0 1"/>
    <body name="puppeteer" mocap="true" pos="0 0 2"><geom size="0.01" contype="0" conaffinity="0"/></body>
    <body name="base">
      <geom type="cylinder" size="0.05 0.05" pos="0 0 0.05" material="steel"/>
      <body name="tower" pos="0 0 0.1">
        <joint name="turn" axis="0 0 1" range="-2.9 2.9"/>
        <geom type="capsule" size="0.04" fromto="0 0 0.04 0 0 0.06" mass="1"/>
        <body name="upper" pos="0 0 0.1">
          <joint name="shoulder" axis="0 1 0" range="-1.5 2.2"/>
          <geom type="capsule" size="0.03" fromto="0 0 0.05 0 0 0.25" mass="1"/>
          <body name="fore" pos="0 0 0.3">
            <joint name="elbow" axis="0 1 0" range="-0.2 2.8"/>
            <geom type="capsule" size="0.025" fromto="0 0 0.05 0 0 0.24" mass="0.5"/>
            <body name="wrist" pos="0 0 0.3">
              <joint name="wrist" axis="0 1 0" range="-0.5 2.8"/>
              <geom type="sphere" size="0.02" mass="0.2"/>
              <camera name="on_the_wrist"/>
              <body name="hand" pos="0 0 0.05">
                <joint name="roll" axis="0 0 1"/>
                <geom type="box" size="0.02 0.06 0.01" pos="0 0 0.01" mass="0.2"/>
                <site name="grip"/>
                FINGERS
              </body>
            </body>
          </body>
        </body>
      </body>
    </body>
  </worldbody>
  <equality><weld body1="puppeteer" body2="hand"/></equality>
  <actuator><motor name="motor" joint="turn"/></actuator>
  <sensor><jointpos joint="turn"/></sensor>
  <keyframe><key name="start" mpos="0 0 2" mquat="1 0 0 0"/></keyframe>
</mujoco>
"""
_SLIDES = """
<body name="left" pos="0 0.005 0.06">
  <joint name="left" type="slide" axis="0 1 0" range="0 0.045"/>
  <geom type="box" size="0.01 0.004 0.04" mass="0.05"/>
</body>
<body name="right" pos="0 -0.005 0.06">
  <joint name="right" type="slide" axis="0 -1 0" range="0 0.045"/>
  <geom type="box" size="0.01 0.004 0.04" mass="0.05"/>
</body>
"""
_HINGES = """
<body name="left" pos="0 0.04 0.02">
  <joint name="left" axis="-1 0 0" range="-0.4 0.8"/>
  <geom type="capsule" size="0.008" fromto="0 0 0.01 0 -0.02 0.08" mass="0.05"/>
</body>
<body name="right" pos="0 -0.04 0.02">
  <joint name="right" axis="1 0 0" range="-0.4 0.8"/>
  <geom type="capsule" size="0.008" fromto="0 0 0.01 0 0.02 0.08" mass="0.05"/>
</body>
"""
JAWS = {
    "slides": (_SLIDES, [0.0, 0.0], [0.045, 0.045]),
    "hinges": (_HINGES, [-0.2, -0.2], [0.6, 0.6]),
}


def model_of(jaws: str = "slides") -> str:
    """The MJCF."""
    return ARM.replace("FINGERS", JAWS[jaws][0])


def tree_of(jaws: str = "slides") -> dict[str, Any]:
    """What the YAML says."""
    _, closed, opened = JAWS[jaws]
    return {
        "model": "own.xml",
        "joints": ["turn", "shoulder", "elbow", "wrist", "roll"],
        "home": [0.0, 0.377, 1.46, 1.3046, 0.0],
        "gains": [2000, 2000, 1500, 800, 500],
        "ee": {"body": "hand", "position": [0, 0, 0.09], "quaternion": [0, 0, 0, 1]},
        "gripper": {
            "joints": ["left", "right"],
            "closed": closed,
            "open": opened,
            "fingers": ["left", "right"],
        },
        "workspace": {"centre": [0.4, 0.0], "half_width": 0.12, "height": 0.1},
    }


def write(
    folder: Path,
    name: str = "own",
    jaws: str = "slides",
    tree: Any = None,
    model: str | None = None,
) -> Path:
    """Write YAML and model; returns the YAML's path."""
    (folder / "own.xml").write_text(model_of(jaws) if model is None else model)
    path = folder / f"{name}.yaml"
    path.write_text(yaml.safe_dump(tree_of(jaws) if tree is None else tree))
    return path
