"""Datasets, policies and evaluations of a command; a wrong path is found by its files, before heavy imports."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.common_options import env_config
from manip_il.cli.options import Given, Open
from manip_il.cli.progress import say, warn
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.evaluation.policy_folder import find_policy, hub_hint

if TYPE_CHECKING:  # the environment and the learner take a second to import
    from manip_il.algorithms.config import RunConfig
    from manip_il.collect.drivers import Driver
    from manip_il.data.schema import RobotTaskSpec
    from manip_il.evaluation.trial import Trial
    from manip_il.learn.checkpoint import Checkpoint
    from manip_il.learn.reward import LearnedReward
    from manip_il.mdp import Observation
    from manip_il.sim.config import CameraConfig, EnvConfig

_NOT_COMPARED = ("processor", "config_sha256", "cameras_sha256")


def require_dataset(root: Path) -> None:
    """Raise `UsageError` unless `root` is a folder with a LeRobot dataset's `meta/info.json`."""
    if not root.exists():
        hint = hub_hint(root, "datasets/")
        raise UsageError(f"{root} does not exist; expected the folder of a LeRobot dataset{hint}")
    if not (root / "meta" / "info.json").is_file():
        raise UsageError(f"{root} is not a LeRobot dataset: it has no meta/info.json{_inside(root)}")


def require_eval(path: Path) -> None:
    """Raise `UsageError` unless `path` is a file, an `eval.json`, or a folder that holds one."""
    meant = f" of manip-il eval; a policy to measure is given as --policy.path={path}"
    if not path.exists():
        raise UsageError(f"{path} does not exist; expected an eval.json{meant}")
    if path.is_dir() and not (path / "eval.json").is_file():
        raise UsageError(f"{path} holds no eval.json{meant}")


def require_folder(path: Path, what: str) -> None:
    """Raise `UsageError` unless there is such a folder. what: its expected content."""
    if not path.is_dir():
        raise UsageError(f"{path} {'is not a folder' if path.exists() else 'does not exist'}; expected {what}")


def require_file(path: Path, what: str) -> None:
    """Raise `UsageError` unless there is such a file. what: its expected content."""
    if not path.is_file():
        raise UsageError(f"{path} {'is no file' if path.exists() else 'does not exist'}; expected {what}")


def _inside(root: Path) -> str:
    """Name the datasets in a folder that is none itself, if it holds some."""
    found = sorted(path.parents[1].name for path in root.glob("*/meta/info.json")) if root.is_dir() else []
    return f"; it holds the datasets {', '.join(found[:3])}{' ...' if len(found) > 3 else ''}" if found else ""


def start_policy(settings: Open) -> Open:
    """Return `--policy.*` of what is fitted, with the `pretrained_model` folder that its `path` means."""
    if "path" not in settings:
        return settings
    path = settings["path"]
    if not isinstance(path, str) or not path:
        raise UsageError(f"--policy.path is {path!r}; expected a checkpoint or a run")
    return {**settings, "path": str(find_policy(Path(path).expanduser()))}


def round_policy(settings: Open) -> tuple[Open, Path | None]:
    """Return `--policy.*` of a run's later rounds, and the `pretrained_model` folder that it begins with, if any.

    Of an mlp to begin with, the options are spelled out: those are asked for before LeRobot is imported.
    """
    if "path" not in settings:
        return settings, None
    from manip_il.learn.checkpoint import Checkpoint

    settings = start_policy(settings)
    start = Path(settings["path"])
    if (options := Checkpoint.open(start).mlp_options) is None:
        return settings, start
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: the type is in the checkpoint")
    return options | {name: value for name, value in settings.items() if name != "path"}, start


def check_given(config: RunConfig) -> None:
    """Raise `MismatchError` unless what a run begins with, datasets or a policy, fits its environment; warn as others.

    Raises what `check_policy` raises.
    """
    from manip_il.collect.environments import env_spec
    from manip_il.data.dataset import Dataset
    from manip_il.data.schema import SIM_STATE
    from manip_il.learn.checkpoint import Checkpoint
    from manip_il.learn.sources import check_same_sources

    recorded = None if config.redraw else config.cameras
    here, run = env_spec(config.env, recorded), f"{config.env.robot} {config.env.task} of this run"
    for root in config.datasets:
        given = Dataset.open(root)
        if SIM_STATE not in given.features:
            raise ManipError(
                f"{root} has no {SIM_STATE}: it was not recorded in simulation, so rollouts cannot be added to it; fit "
                f"a policy to it by manip-il train --dataset.root={root}, and begin with that: --policy.path=RUN"
            )
        check_same_sources((root, Path(run)), (given.spec, here), pictures=config.cameras is not None, language=False)
        warn(*dataset_differences(str(root), given.spec, given.fingerprint))
    if config.start is None:
        return
    checkpoint = Checkpoint.open(config.start)
    checkpoint.require_trust(config.fit.trust)
    cameras = check_policy(checkpoint, config.env, draw=False, trust=config.fit.trust)
    for what in ("names", "height", "width"):
        theirs, ours = (getattr(one, what, None) for one in (cameras, config.cameras))
        if theirs != ours:
            raise MismatchError(f"cameras' {what}", str(config.start), theirs, "this run", ours)


def dataset_differences(name: str, spec: RobotTaskSpec, fingerprint: Mapping[str, Any]) -> list[str]:
    """Return in what a dataset was made by other versions or another model than this machine has, a line each.

    name: of the dataset. Raises `MismatchError` if its numbers mean something else. A dataset of a user's own arm or
    task, whose name alone it holds, is not compared.
    """
    from manip_il.collect.environments import env_fingerprint, env_spec, is_known
    from manip_il.data.fingerprint import compare_fingerprints
    from manip_il.data.schema import check_same_spec
    from manip_il.sim.env import EnvConfig

    if not is_known(spec.robot, spec.task):
        return []
    env = EnvConfig(spec.robot, spec.task, spec.fps, object=spec.object)
    check_same_spec(name, spec, "this program", env_spec(env))
    # Tolerance and horizon change nothing that is learnt, and a dataset does not hold them; nor are pictures compared.
    here = {key: value for key, value in env_fingerprint(env).items() if key not in _NOT_COMPARED}
    theirs = {key: value for key, value in fingerprint.items() if key not in _NOT_COMPARED}
    return compare_fingerprints(name, theirs, "this machine", here)


def open_driver(
    policy: Path | None,
    kind: str,
    env: Given | EnvConfig,
    *,
    draw: bool = True,
    trust: bool = False,
    quiet: bool = False,
) -> tuple[EnvConfig, Driver, CameraConfig | None]:
    """Return what drives, checked, the environment that it drives, and the cameras whose pictures it takes.

    policy: a checkpoint or a run, else `kind`: expert, random or sliders. env: an environment, or what was given of it:
    the rest is as the policy has it. draw, trust: see `check_policy`. quiet: do not say which pictures it takes.
    """
    from manip_il.collect.drivers import PolicyDriver, driver_of
    from manip_il.learn.checkpoint import Checkpoint

    if policy is None:
        return env_config(env) if isinstance(env, dict) else env, driver_of(kind), None
    checkpoint = Checkpoint.open(path := find_policy(policy))
    config = env_config(env, checkpoint.origin) if isinstance(env, dict) else env
    cameras = check_policy(checkpoint, config, draw=draw, trust=trust)
    if cameras is not None and not quiet:
        say(_observation_text(cameras, checkpoint))
    return config, PolicyDriver((path,), trust=trust), cameras


def check_space(policy: Path, space: str | None) -> None:
    """Raise `MismatchError` for a checkpoint of another action space than the one asked for."""
    if space is None:
        return
    from manip_il.learn.checkpoint import Checkpoint

    path = find_policy(policy)
    if (theirs := Checkpoint.open(path).space) != space:
        raise MismatchError("action space", str(path), theirs, "--action_space", space)


def check_policy(
    checkpoint: Checkpoint, env: EnvConfig, *, draw: bool = True, trust: bool = False
) -> CameraConfig | None:
    """Return the cameras whose pictures the policy takes, if any; warn if it was trained on something else.

    draw: make its first pictures here, to see that they can be made. trust: see `LearnedPolicy.load`. Raises
    `MismatchError` unless the policy can drive `env`, `RenderError` if there is no OpenGL for its pictures, and what
    `LearnedPolicy.load` raises.
    """
    from manip_il.collect.environments import env_spec
    from manip_il.learn.policy import LearnedPolicy
    from manip_il.learn.policy_files import policy_cameras

    cameras = policy_cameras(checkpoint.path)
    spec = env_spec(env, cameras)
    checkpoint.check_fits(spec)
    warn(*_differences(checkpoint, env, cameras))
    policy = LearnedPolicy.load(checkpoint, task=spec.instruction, trust=trust)
    # One action now finds what else does not fit before a worker does.
    observation = _first_observation(env, cameras, draw)
    images = {camera: picture[None] for camera, picture in observation.images.items()}
    policy.act(observation.state[None], observation.environment_state[None], images)
    return cameras


def check_policies(policies: dict[str, Path], trial: Trial, folder: Path, engine: str) -> None:
    """Raise, before any episode runs, if one of the policies (name -> folder) cannot take a test."""
    from manip_il.learn.checkpoint import Checkpoint

    for name, policy in policies.items():
        if not trial.file(folder, policy).is_file():
            checkpoint = Checkpoint.open(policy)
            origin = checkpoint.origin
            if origin is not None and origin.task != trial.env.task:
                raise MismatchError("task", name, origin.task, "the comparison", trial.env.task)
            check_policy(checkpoint, trial.env, draw=engine == "local", trust=trial.trust)


def _differences(checkpoint: Checkpoint, env: EnvConfig, cameras: CameraConfig | None) -> list[str]:
    from manip_il.collect.environments import env_fingerprint
    from manip_il.data.fingerprint import compare_fingerprints

    path, meta = checkpoint.path, checkpoint.origin
    if meta is None:
        lines = [f"{path} was written by another tool and does not say which robot and task it is for"]
        return [*lines, f"nor how its pictures were lit: {cameras.look} is assumed"] if cameras else lines
    if meta.task != env.task:  # and with it the model and its hash
        return [f"task differs: {path} has {meta.task}, the environment has {env.task}"]
    theirs = dict(meta.fingerprint)
    if cameras is None:
        theirs.pop("cameras_sha256", None)  # it takes no pictures
    return compare_fingerprints(str(path), theirs, "the environment", env_fingerprint(env, cameras))


def _first_observation(env: EnvConfig, cameras: CameraConfig | None, draw: bool) -> Observation:
    import numpy as np

    from manip_il.collect.environments import make_env

    world = make_env(env, cameras if draw else None)
    world.start(0)
    observation = world.observe()
    if cameras is None or draw:
        return observation
    return replace(observation, images={name: np.zeros((*cameras.size, 3), np.uint8) for name in cameras.names})


def _observation_text(cameras: CameraConfig, checkpoint: Checkpoint) -> str:
    lights = ", ".join(f"{name} {value}" for name, value in asdict(cameras.look).items())
    size = f"{cameras.height} x {cameras.width} pixels"
    return f"observation {checkpoint.observation!r}: the policy uses {', '.join(cameras.names)}, {size}, {lights}"


def load_reward(path: Path) -> LearnedReward:
    """Return the reward in a folder of `fit`, or in its `pretrained_model`. Raises what `LearnedReward.load` raises."""
    from manip_il.learn.reward import LearnedReward

    require_folder(path, "a reward of manip-il reward fit")
    return LearnedReward.load(reward_folder(path))


def reward_folder(path: Path) -> Path:
    """Return the `pretrained_model` folder that a path means."""
    inner = path / "pretrained_model"
    return inner if (inner / "config.json").is_file() else path
