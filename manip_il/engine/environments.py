"""Descriptions of an environment, and of the policy in it, for datasets, checkpoints and evaluations."""

from __future__ import annotations

import hashlib
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.fingerprint import canonical_json, environment_fingerprint
from manip_il.data.schema import RobotTaskSpec
from manip_il.engine.simulations import simulation_of
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.checkpoint import META_FILE, read_meta
from manip_il.learn.pretrained import read_interface
from manip_il.mdp import State
from manip_il.robots.action_space import ActionSpace
from manip_il.sim.config import CAMERAS, CameraConfig, EnvConfig, Look
from manip_il.sim.props import VERSION as DRAWN

_FOR_PEOPLE = ("README.md", "train_config.json")  # beside a policy, and no part of how it acts


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> RobotTaskSpec:
    """Return names, sizes and rate that a dataset or policy for this environment must share."""
    return simulation_of(config.robot).spec(config, cameras)


def env_actions(config: EnvConfig) -> ActionSpace:
    """Return names, bounds and scale of an environment's actions, (n,)."""
    return simulation_of(config.robot).actions(config)


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, Any]:
    """Return versions, and hashes of the compiled model and of the environment's and the cameras' settings."""
    if cameras is None:
        return dict(_fingerprint(config))
    look = hashlib.sha256(f"{canonical_json(cameras)} {DRAWN}".encode()).hexdigest()
    return {**_fingerprint(config), "cameras_sha256": look}


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    settings = asdict(config)
    for name in ("object", "reward"):  # as before there were any
        if not settings[name]:
            del settings[name]
    return environment_fingerprint(simulation_of(config.robot).model_bytes(config), settings)


def policy_sha256(policy: Path) -> str:
    """Return the SHA-256 of everything in a policy's folder that decides how it acts, but not of where it lies."""
    digest = hashlib.sha256()
    for path in sorted(policy.iterdir()):
        if path.is_file() and path.name not in _FOR_PEOPLE:
            digest.update(path.name.encode() + b"\0" + hashlib.sha256(path.read_bytes()).digest())
    return digest.hexdigest()


def policy_cameras(policy: Path) -> CameraConfig | None:
    """Return cameras, size and light of the pictures that a checkpoint was trained with; None for one without.

    The light is the default where the checkpoint does not say. Raises `MismatchError` for cameras that environments do
    not have or whose pictures differ in size, `ManipError` for a folder or a size that cannot be.
    """
    pictures, meta = read_interface(policy).pictures, read_meta(policy)
    if not pictures:
        return None
    if not set(pictures) <= set(CAMERAS):
        raise MismatchError("cameras", str(policy), ", ".join(pictures), "the environment", ", ".join(CAMERAS))
    if len(set(pictures.values())) > 1:
        sizes = ", ".join(f"{camera} {size}" for camera, size in pictures.items())
        raise MismatchError("size of pictures", str(policy), sizes, "the environment", "one size for all cameras")
    as_recorded = meta is not None and set(meta.cameras) == set(pictures)
    names = meta.cameras if meta is not None and as_recorded else tuple(pictures)
    height, width = next(iter(pictures.values()))
    try:
        return CameraConfig(names, height, width, Look(**(meta.look or {}) if meta else {}))
    except (UsageError, TypeError) as error:
        raise ManipError(f"{policy}: its pictures cannot be rendered ({error}); see its {META_FILE}") from error


def positions(env: EnvConfig, sim_state: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return the true positions [m] in one row of `sim_state` (m,): `hand`, objects, and `goal`.

    The first object that the episode is about is called `object`; `goal` is where it, or the hand, is to go.
    """
    found = simulation_of(env.robot).positions(env, State.from_vector(sim_state))
    return {name: [round(float(value), 4) for value in at] for name, at in found.items()}
