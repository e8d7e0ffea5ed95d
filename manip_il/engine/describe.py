"""What an environment is, in the words of datasets and checkpoints."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

from manip_il.data.fingerprint import canonical_json, environment_fingerprint
from manip_il.data.schema import RobotTaskSpec
from manip_il.mdp import STATE_EXTRAS
from manip_il.sim.env import EnvConfig
from manip_il.sim.look import CameraConfig
from manip_il.sim.observe import environment_state_names
from manip_il.sim.scene import build_scene
from manip_il.tasks.task import phases

_TOLD_TO_PEOPLE = ("README.md", "train_config.json")  # beside a policy, and no part of how it acts


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
    """Names, sizes and rate that a dataset or policy for this environment must share."""
    scene = build_scene(config.robot, config.task)
    return RobotTaskSpec(
        robot=scene.robot.name,
        task=config.task,
        fps=config.control_hz,
        joint_names=scene.robot.joint_names,
        environment_state_names=environment_state_names(scene),
        sim_state_size=scene.state_size + len(scene.nominal) + STATE_EXTRAS,
        instruction=scene.task.instruction,
        phases=phases(scene.task),
        cameras=cameras.names if cameras else (),
        image_size=(cameras.height, cameras.width) if cameras else (0, 0),
    )


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, Any]:
    """Versions, and hashes of the compiled model and of the environment's settings; with cameras, of theirs too."""
    look = {"cameras_sha256": hashlib.sha256(canonical_json(cameras).encode()).hexdigest()} if cameras else {}
    return {**_fingerprint(config), **look}


def policy_sha256(policy: Path) -> str:
    """Of everything in a policy's folder that decides how it acts: the same wherever it lies and whatever its name."""
    digest = hashlib.sha256()
    for path in sorted(policy.iterdir()):
        if path.is_file() and path.name not in _TOLD_TO_PEOPLE:
            digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    return environment_fingerprint(build_scene(config.robot, config.task).model_bytes(), asdict(config))
