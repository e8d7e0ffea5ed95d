"""LeRobot's policies and processors: made for a fit, and loaded from a checkpoint."""

from __future__ import annotations

import contextlib
import io
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import draccus
import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from manip_il import checks
from manip_il.data.schema import IMAGES
from manip_il.errors import ManipError, UnknownName
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.action_steps import add_steps  # known here, they are known to what is loaded
from manip_il.learn.checkpoint import CONFIG, MEASURED, PROCESSORS, Checkpoint
from manip_il.learn.lerobot_config import policy_class, policy_types
from manip_il.learn.names import MLP
from manip_il.learn.network import warm_start
from manip_il.learn.training_state import readable_state

_DEVICE_STEP = "device_processor"
_SMALLEST = {"std": 1e-3, "range": 1e-2}  # [rad] or [m]: less than this in all of the data is noise, not scale


def build_policy(config: PreTrainedConfig, meta: Any, resumed: Path | None = None) -> PreTrainedPolicy:
    """Return LeRobot's policy, its weights new, from `config.pretrained_path`, or those of a run that is resumed.

    An mlp that starts from another one's weights has the units of its own data, see `warm_start`. Raises `ManipError`
    for a checkpoint that cannot be loaded, and with the two ways out if a backbone's weights would have to be
    downloaded and cannot be.
    """
    start, weights = config.pretrained_path, getattr(config, "pretrained_backbone_weights", None)
    warm = config.type == MLP and start is not None and resumed is None
    config.pretrained_path = None if warm else resumed or start
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and standard output belongs to the caller
            policy = make_policy(config, ds_meta=meta)
    except ManipError:
        raise
    except ImportError as error:
        raise ManipError(f"--policy.type={config.type} needs more packages: {error}") from error
    except Exception as error:  # weights from anywhere, read by the code of any policy: errors of every kind
        if config.pretrained_path is not None:
            line = f"{type(error).__name__}: {checks.one_line(error)}"
            raise ManipError(f"{config.pretrained_path} does not fit this policy: {line}") from error
        if not weights or not isinstance(error, OSError):
            raise
        raise ManipError(
            f"cannot download {weights} ({error}): train from scratch with --policy.pretrained_backbone_weights=null, "
            f"or put the file that torchvision names into {torch.hub.get_dir()}/checkpoints"
        ) from error
    if warm:
        model: Any = policy.model
        warm_start(model, Path(str(start)))
    if weights:  # a checkpoint has its own: it shall load if there is no network
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    config.pretrained_path = None
    return policy


def build_processors(
    config: PreTrainedConfig,
    meta: Any,
    checkpoint: Path | None,
    *,
    trust: bool = False,
    conversion: Conversion | None = None,
) -> tuple[Any, Any]:
    """Return LeRobot's pre- and postprocessor, with the dataset's statistics, on going on with the checkpoint's.

    conversion: of the actions, which the dataset's metadata then has, if the processors are to carry one. Raises
    what `Checkpoint.require_trust` raises, and `ManipError` if the checkpoint's cannot be read.
    """
    if checkpoint is None:
        before, after = make_pre_post_processors(config, dataset_stats=usable_statistics(meta.stats), dataset_meta=meta)
        if conversion is not None:
            add_steps(before, after, conversion)
        return before, after
    opened = Checkpoint.open(checkpoint)
    opened.require_processors()
    opened.require_trust(trust)
    converted = {} if conversion is None else {MEASURED: {"converted": True}}
    overrides = {_DEVICE_STEP: {"device": config.device}, **converted}
    with readable_state(checkpoint):
        return make_pre_post_processors(config, str(checkpoint), preprocessor_overrides=overrides)


def usable_statistics(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a dataset's statistics with a least deviation and range for vectors.

    Without it, a joint that hardly moved in the data would be many deviations off wherever it does move.
    """
    usable: dict[str, dict[str, Any]] = {}
    for key, values in stats.items():
        usable[key] = own = {name: np.array(value) for name, value in values.items()}
        if key.startswith(IMAGES) or "std" not in own:
            continue
        own["std"] = np.maximum(own["std"], _SMALLEST["std"])
        for low, high in (("min", "max"), ("q01", "q99"), ("q10", "q90")):
            if low in own and high in own:
                own[high] = np.maximum(own[high], own[low] + _SMALLEST["range"])
    return usable


def load_policy(checkpoint: Checkpoint, device: str, trust: bool = False) -> tuple[PreTrainedPolicy, Any, Any]:
    """Return the policy of a checkpoint and its processors, without a network if LeRobot needs none.

    Raises `UnknownName` for a type that is not known, `ManipError` if packages are missing, if what it names would have
    to be trusted and is not, or if LeRobot cannot load the folder.
    """
    kind, path = checkpoint.kind, checkpoint.path
    if kind not in policy_types():
        raise UnknownName(f"policy type in {path / CONFIG}:", kind, policy_types())
    checkpoint.require_processors()
    checkpoint.require_trust(trust)
    try:
        with contextlib.redirect_stdout(io.StringIO()):  # LeRobot prints, and standard output belongs to the caller
            return _load(checkpoint, device)
    except ImportError as error:
        raise ManipError(
            f"{path} is a policy of type {kind!r}, which needs more packages: {checks.one_line(error)}"
        ) from error
    except Exception as error:  # a folder from anywhere, read by the code of any policy: errors of every kind
        raise ManipError(f"{path}: LeRobot cannot load it: {type(error).__name__}: {checks.one_line(error)}") from error


def _load(checkpoint: Checkpoint, device: str) -> tuple[PreTrainedPolicy, Any, Any]:
    own = {key: value for key, value in checkpoint.config.items() if key != "type"}
    # Not `PreTrainedConfig.from_pretrained`, which leaves a temporary file behind each time
    config = draccus.decode(policy_class(checkpoint.kind), own | {"device": device})
    # Weights come from the checkpoint; torchvision would download its own first.
    if hasattr(config, "pretrained_backbone_weights"):
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    policy = get_policy_class(checkpoint.kind).from_pretrained(checkpoint.path, config=config, strict=True)
    placed = any(step["registry_name"] == _DEVICE_STEP for step in checkpoint.processors[PROCESSORS[0]])
    overrides = {_DEVICE_STEP: {"device": device}} if placed else {}
    before, after = make_pre_post_processors(config, str(checkpoint.path), preprocessor_overrides=overrides)
    return policy, before, after
