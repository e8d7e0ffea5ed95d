"""What a fit of a LeRobot policy starts with: the policy, its processors, its data."""

from __future__ import annotations

import contextlib
import hashlib
import io
import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from urllib.error import URLError

import numpy as np
import torch
from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.policies.factory import make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.frame_cache import open_frame_cache
from manip_il.data.lerobot_library import lerobot_windows
from manip_il.data.lerobot_read import read_tables
from manip_il.data.schema import ACTION, IMAGES, LABEL_VALID
from manip_il.errors import ManipError, NotFiniteError
from manip_il.learn.checkpoint import readable_state
from manip_il.learn.columns import EPISODE_INDEX, FRAME_INDEX, INDEX, split_by_episode
from manip_il.learn.limits import Budget
from manip_il.learn.observation import policy_features
from manip_il.learn.policy_config import PolicyFitConfig
from manip_il.learn.pretrained import WEIGHTS, check_processors, read_config
from manip_il.learn.sources import TASK_INDEX, JoinedFrames, LibrarySource, MemorySource, Source
from manip_il.learn.trust import PLAIN, require_trust
from manip_il.learn.windows import Windows, windows_of

_LOG = logging.getLogger(__name__)
I64 = NDArray[np.int64]
_ALWAYS = (EPISODE_INDEX, FRAME_INDEX, INDEX, TASK_INDEX, "timestamp")  # LeRobot's own columns
_ROUND = {"std": 1e-3, "range": 1e-2}  # [rad] or [m]: less than this in all of the data is noise, not scale
_MAX_HELD_OUT = 1_024  # samples that a validation looks at


@dataclass(frozen=True)
class Samples:
    """The data of one fit. train, held_out: sample numbers; digest: of everything that is learnt from."""

    source: Source
    train: I64
    held_out: I64
    cameras: tuple[str, ...]
    digest: str


def set_features(config: PreTrainedConfig, meta: Any, observation: str) -> None:
    """Tell a policy what it sees and gives, from the dataset's features and the observation choice.

    LeRobot's policies for states leave `observation.environment_state` in its raw units unless told otherwise: here
    it is normalised as the joint state is. Raises what `policy_features` raises, `ManipError` for what the policy
    refuses.
    """
    config.input_features, config.output_features = policy_features(meta.features, observation)
    modes: dict[str, NormalizationMode] = getattr(config, "normalization_mapping", {})
    if "STATE" in modes:
        modes.setdefault("ENV", modes["STATE"])
    try:
        config.validate_features()
    except ValueError as error:
        raise ManipError(f"--policy.type={config.type} with --observation={observation}: {error}") from error


def build_policy(config: PreTrainedConfig, meta: Any) -> PreTrainedPolicy:
    """Return LeRobot's policy, its weights new or from `config.pretrained_path`.

    Raises `ManipError` for a checkpoint that cannot be loaded, and with the two ways out where a backbone's weights
    would have to be downloaded and cannot be.
    """
    weights = getattr(config, "pretrained_backbone_weights", None)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and standard output belongs to the caller
            policy = make_policy(config, ds_meta=meta) if config.pretrained_path is None else _loaded(config, meta)
    except (URLError, OSError) as error:
        if not weights or isinstance(error, FileNotFoundError):
            raise
        raise ManipError(
            f"cannot download {weights} ({error}): train from scratch with --policy.pretrained_backbone_weights=null, "
            f"or put the file that torchvision names into {torch.hub.get_dir()}/checkpoints"
        ) from error
    except ImportError as error:
        raise ManipError(f"--policy.type={config.type} needs more packages: {error}") from error
    if weights:  # a checkpoint has its own: it shall load where there is no network
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    config.pretrained_path = None
    return policy


def _loaded(config: PreTrainedConfig, meta: Any) -> PreTrainedPolicy:
    """LeRobot's policy with a checkpoint's weights."""
    path = Path(str(config.pretrained_path))
    try:
        with Budget(path / WEIGHTS) if config.type in PLAIN else contextlib.nullcontext():
            return make_policy(config, ds_meta=meta)
    except ImportError:
        raise
    except Exception as error:  # weights from anywhere, read by the code of any policy: errors of every kind
        line = checks.shorten(" ".join(str(error).split()))
        raise ManipError(f"{path} does not fit this policy: {type(error).__name__}: {line}") from error


def build_processors(
    config: PreTrainedConfig, meta: Any, checkpoint: Path | None, *, trust: bool = False
) -> tuple[Any, Any]:
    """Return LeRobot's pre- and postprocessor, with the dataset's statistics, on going on with the checkpoint's.

    Raises what `require_trust` raises for the checkpoint's, and `ManipError` where they cannot be read.
    """
    if checkpoint is None:
        return make_pre_post_processors(config, dataset_stats=usable_statistics(meta.stats), dataset_meta=meta)
    check_processors(checkpoint)
    require_trust(read_config(checkpoint), str(checkpoint), trust, checkpoint)
    device = {"device_processor": {"device": config.device}}
    with readable_state(checkpoint):
        return make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=device)


def usable_statistics(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a dataset's statistics with a least deviation and range for vectors.

    A joint that hardly moved in the data would else be blown up to many deviations wherever it does.
    """
    usable: dict[str, dict[str, Any]] = {}
    for key, values in stats.items():
        usable[key] = own = {name: np.array(value) for name, value in values.items()}
        if key.startswith(IMAGES) or "std" not in own:
            continue
        own["std"] = np.maximum(own["std"], _ROUND["std"])
        for low, high in (("min", "max"), ("q01", "q99"), ("q10", "q90")):
            if low in own and high in own:
                own[high] = np.maximum(own[high], own[low] + _ROUND["range"])
    return usable


def load_samples(
    roots: Sequence[Path], config: PolicyFitConfig, meta: Any, on_frames: Callable[[int], None] | None = None
) -> Samples:
    """Return the samples of datasets, taken as one, for one policy; in memory where they fit.

    on_frames: sees how many frames more have been decoded. Raises `NotFiniteError`, and what `windows_of` and
    `Windows.usable` raise.
    """
    policy = config.policy
    features = [*(policy.input_features or {}), ACTION]
    cameras = tuple(key for key in features if key in meta.camera_keys)
    numbers = [key for key in features if key not in cameras]
    label = [LABEL_VALID] if LABEL_VALID in meta.features else []
    table = read_tables(roots, [*numbers, *_ALWAYS, *label])
    _require_finite(roots[0], table, numbers)
    episodes = table[EPISODE_INDEX].astype(np.int64).reshape(-1)
    valid = table[LABEL_VALID].reshape(-1) != 0 if label else np.ones(len(episodes), dtype=bool)
    windows = windows_of(policy, features, episodes)
    usable = windows.usable(valid, getattr(policy, "drop_n_last_frames", 0))
    train, held_out = split_by_episode(episodes[usable], config.eval_split, config.seed)
    return Samples(
        source=_source(roots, config, meta, windows, {key: table[key] for key in (*numbers, *_ALWAYS)}, on_frames),
        train=usable[train],
        held_out=_evenly(usable[held_out], _MAX_HELD_OUT),
        cameras=cameras,
        digest=_digest(roots, table),
    )


def _source(
    roots: Sequence[Path], config: PolicyFitConfig, meta: Any, windows: Windows, table: Any, on_frames: Any
) -> Source:
    cameras = [key for key in config.policy.input_features or {} if key in meta.camera_keys]
    limit = int(config.image_cache_gb * 1e9)
    frames = _frames(roots, cameras, limit, on_frames)
    if frames is None:
        names = ", ".join(map(str, roots))
        _LOG.warning(
            "the pictures of %s take more than %g GB: LeRobot's loader decodes them on the fly", names, limit / 1e9
        )
        ahead = {key: [delta / meta.fps for delta in deltas.tolist()] for key, deltas in windows.deltas.items()}
        read = [lerobot_windows(root, meta.repo_id, ahead or None) for root in roots]
        return LibrarySource(torch.utils.data.ConcatDataset(read), config.num_workers)
    columns = {key: torch.from_numpy(np.array(values)) for key, values in table.items()}
    return MemorySource(windows, columns, frames, tuple(map(str, meta.tasks.index)))


def _frames(roots: Sequence[Path], cameras: list[str], limit: int, on_frames: Any) -> dict[str, JoinedFrames] | None:
    """Camera -> the pictures of all datasets; None where they would take more than `limit` bytes."""
    found: list[Mapping[str, Any]] = []
    for root in roots if cameras else []:
        frames = open_frame_cache(root, cameras, max_bytes=limit, on_frames=on_frames)
        if frames is None:
            return None
        limit -= sum(one.nbytes for one in frames.values())
        found.append(frames)
    return {camera: JoinedFrames([frames[camera] for frames in found]) for camera in cameras}


def _require_finite(root: Path, table: Mapping[str, NDArray[Any]], keys: list[str]) -> None:
    for key in keys:
        finite = np.isfinite(table[key]).reshape(len(table[key]), -1).all(axis=1)
        if not finite.all():
            row = int(np.flatnonzero(~finite)[0])
            episode = int(table[EPISODE_INDEX].reshape(-1)[row])
            raise NotFiniteError(f"{root}: column {key}, episode {episode}, row {row}: {table[key][row]} is not finite")


def _evenly(samples: I64, most: int) -> I64:
    return samples if len(samples) <= most else samples[np.linspace(0, len(samples) - 1, most).astype(np.int64)]


def _digest(roots: Sequence[Path], table: Mapping[str, NDArray[Any]]) -> str:
    """Of the columns, and of the datasets' statistics, which stand for the pictures."""
    digest = hashlib.sha256()
    for root in roots:
        digest.update((root / "meta" / "stats.json").read_bytes())
    for key, column in table.items():
        digest.update(key.encode())
        digest.update(np.ascontiguousarray(column).tobytes())
    return digest.hexdigest()
