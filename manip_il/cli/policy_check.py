"""Before the first episode: whether a policy can drive an environment, and what is different from its training."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.cli.groups import warn

if TYPE_CHECKING:
    from manip_il.learn.checkpoint import CheckpointMeta
    from manip_il.mdp import Observation
    from manip_il.sim.env import EnvConfig
    from manip_il.sim.look import CameraConfig


def check_policy(
    path: Path, meta: CheckpointMeta | None, env: EnvConfig, *, draw: bool = True, trust: bool = False
) -> CameraConfig | None:
    """Return the cameras that the policy looks at, None for none.

    Warns where it was trained on something else than `env`.

    draw: make its first pictures here, to see that they can be made. trust: see `LearnedPolicy.load`. Raises
    `MismatchError` unless the policy can drive `env`, `RenderError` where there is no OpenGL for its pictures, and what
    `LearnedPolicy.load` raises.
    """
    from manip_il.engine.environments import env_spec, policy_cameras
    from manip_il.learn.checkpoint import check_fits
    from manip_il.learn.policy import LearnedPolicy
    from manip_il.learn.pretrained import check_interface, read_interface

    cameras = policy_cameras(path)
    spec = env_spec(env, cameras)
    if meta is not None:
        check_fits(meta, spec)
    check_interface(read_interface(path), spec)
    warn(_differences(path, meta, env, cameras))
    policy = LearnedPolicy.load(path, task=spec.instruction, trust=trust)
    # One action now says what else would not fit before a worker does.
    seen = _first_sight(env, cameras, draw)
    images = {camera: picture[None] for camera, picture in seen.images.items()}
    policy.act(seen.state[None], seen.environment_state[None], images)
    return cameras


def _differences(path: Path, meta: CheckpointMeta | None, env: EnvConfig, cameras: CameraConfig | None) -> list[str]:
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.engine.environments import env_fingerprint

    if meta is None:
        lines = [f"{path} was written by another tool and does not say which robot and task it is for"]
        return [*lines, f"nor how its pictures were lit: {cameras.look} is assumed"] if cameras else lines
    if meta.task != env.task:  # and with it the model and all that is hashed of it
        return [f"task differs: {path} has {meta.task}, the environment has {env.task}"]
    theirs = dict(meta.fingerprint)
    if cameras is None:
        theirs.pop("cameras_sha256", None)  # it sees none
    return compare_fingerprints(str(path), theirs, "the environment", env_fingerprint(env, cameras))


def _first_sight(env: EnvConfig, cameras: CameraConfig | None, draw: bool) -> Observation:
    import numpy as np

    from manip_il.sim.env import ManipEnv

    if cameras is None or not draw:
        world = ManipEnv(config=env)
    else:
        world = ManipEnv(config=env, cameras=cameras.names, image_size=cameras.size, look=cameras.look)
    world.start(0)
    seen = world.observe()
    if cameras is not None and not draw:
        return replace(seen, images={name: np.zeros((*cameras.size, 3), np.uint8) for name in cameras.names})
    return seen


def looks(cameras: CameraConfig, path: Path) -> str:
    """What a policy of pictures looks at, in words."""
    from manip_il.learn.pretrained import read_interface

    observation = read_interface(path).observation
    lights = ", ".join(f"{name} {value}" for name, value in asdict(cameras.look).items())
    size = f"{cameras.height} x {cameras.width} pixels"
    return f"observation {observation!r}: the policy uses {', '.join(cameras.names)}, {size}, {lights}"
