"""Worlds by the robot's name, and what is made from an environment's settings.

Importing this module loads no simulator: a world is imported when it is first used.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from importlib import import_module
from typing import TYPE_CHECKING, NamedTuple

from manip_il.caching import cached_per_thread
from manip_il.option import NameOrPath
from manip_il.sim.config import CameraConfig

if TYPE_CHECKING:
    from manip_il.sim.conditions import Condition
    from manip_il.worlds.config import EnvConfig
    from manip_il.worlds.contract import Environment, EnvironmentSpec, Expert, WorldKind

_KEPT = 4  # environments and experts kept for each thread: the finest scenes take 64 MB


class Listed(NamedTuple):
    """What help says of a world, and the module whose `WORLD` makes it."""

    module: str
    about: str
    tasks: tuple[str, ...]
    cameras: tuple[str, ...] = ()


WORLDS: dict[NameOrPath, Listed] = {
    "fetch_stock": Listed(
        "manip_il.worlds.fetch.expert",
        "gymnasium-robotics' Fetch",
        ("FetchReach-v4", "FetchPush-v4", "FetchPickAndPlace-v4"),
    ),
    "aloha": Listed(
        "manip_il.worlds.aloha.expert",
        "gym_aloha's two arms",
        ("AlohaTransferCube-v0", "AlohaInsertion-v0"),
        ("top", "angle", "front_close", "left_pillar", "right_pillar", "left_wrist", "right_wrist"),
    ),
}
_OURS = "manip_il.worlds.ladder.world"  # of every other robot


def world_of(robot: NameOrPath) -> WorldKind:
    """Return the world of a robot."""
    return import_module(WORLDS[robot].module if robot in WORLDS else _OURS).WORLD


def make_env(
    config: EnvConfig, cameras: CameraConfig | None = None, conditions: Sequence[Condition] = ()
) -> Environment:
    """Make an environment.

    Args:
        config: Its settings, complete.
        cameras: What it observes besides numbers.
        conditions: How episodes differ from the nominal world, in turn by seed.

    Raises:
        Unable: if the environment cannot be drawn or varied.
        UnknownName: for a camera that it does not have.
    """
    spec = env_spec(config, cameras)
    if changed := [one.name for one in conditions if one.ranges]:
        spec.require("varied", f"leave out {', '.join(changed)}")
    return world_of(config.robot).environment(config, cameras, conditions)


@cached_per_thread(_KEPT)
def described_env(config: EnvConfig) -> Environment:
    """Return an environment, cached for this thread, to read from; no episode runs in it."""
    return world_of(config.robot).environment(config, None, ())


@cached_per_thread(_KEPT)
def make_expert(config: EnvConfig) -> Expert:
    """Return the expert of an environment, cached for this thread."""
    return world_of(config.robot).expert(config)


@cache
def env_spec(config: EnvConfig, cameras: CameraConfig | None = None) -> EnvironmentSpec:
    """Return what a dataset or a policy for this environment must share. Raises what `make_env` raises for cameras."""
    spec = described_env(config).spec
    if cameras is None:
        return spec
    spec.require_cameras(cameras)
    return replace(spec, cameras=cameras.names, image_size=cameras.size, keypoints=spec.points)


def env_fingerprint(config: EnvConfig, cameras: CameraConfig | None = None) -> dict[str, str]:
    """Return package versions, processor, and hashes of the compiled model and of environment and camera settings."""
    look = {} if cameras is None else {"cameras_sha256": world_of(config.robot).look_sha256(config, cameras)}
    return _fingerprint(config) | look


@cache
def _fingerprint(config: EnvConfig) -> dict[str, str]:
    return world_of(config.robot).fingerprint(config)
