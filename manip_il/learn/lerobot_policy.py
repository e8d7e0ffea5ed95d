"""LeRobot's policies and processors, built for a fit or loaded from a checkpoint."""

import contextlib
import io
import warnings
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import draccus
import numpy as np
from lerobot.configs import PreTrainedConfig
from lerobot.policies.factory import get_policy_class, make_policy, make_pre_post_processors
from lerobot.policies.pretrained import PreTrainedPolicy

from manip_il.data.schema import IMAGES
from manip_il.learn.action_spaces import Conversion

# importing it registers our steps for loading
from manip_il.learn.action_steps import JointsAloneStep, add_steps
from manip_il.learn.checkpoint import MEASURED, PROCESSORS, Checkpoint, in_one_line
from manip_il.learn.lerobot_config import policy_class
from manip_il.learn.names import CNN, MLP
from manip_il.learn.network import warm_start

_DEVICE_STEP = "device_processor"
# [rad] or [m]: less variation than this in all of the data is noise
_SMALLEST = {"std": 1e-3, "range": 1e-2}


def build_policy(
    config: PreTrainedConfig, meta: Any, resumed: Checkpoint | None = None
) -> PreTrainedPolicy:
    """Return a LeRobot policy for training.

    An mlp that starts from another mlp's weights takes input statistics from the new data, see
    `warm_start`; a cnn takes the range of its actions from the new data.

    Args:
        config: The policy's options. The weights are those in its `pretrained_path`, else new.
        meta: The metadata of the training data.
        resumed: The checkpoint of a run to continue, whose weights count instead.

    Raises:
        ManipError: A checkpoint cannot be loaded, or a backbone's weights cannot be downloaded.
    """
    start, weights = config.pretrained_path, getattr(config, "pretrained_backbone_weights", None)
    if resumed is not None:
        start = None
        config.pretrained_path = resumed.path
    if start is not None and config.type == MLP:
        config.pretrained_path = None  # `warm_start` loads it
    what = f"{config.pretrained_path} does not fit this policy"
    if config.pretrained_path is None:
        what = f"cannot build --policy.type={config.type}"
    if weights:
        what += f" with --policy.pretrained_backbone_weights={weights} (offline, use null)"
    with _lerobot(what):
        policy: Any = make_policy(config, ds_meta=meta)
    if start is not None and config.type == MLP:
        warm_start(policy.model, Path(start))
    if start is not None and config.type == CNN:  # acts within the range of the new data
        policy.model.target_low, policy.model.target_high = policy.target_range
    if weights:  # the checkpoint will have all weights, so loading it needs no network
        config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
    config.pretrained_path = None
    return policy


def build_processors(
    config: PreTrainedConfig, meta: Any, conversion: Conversion | None = None
) -> tuple[Any, Any]:
    """Return new LeRobot pre- and postprocessors with the dataset's statistics.

    Args:
        config: The policy's options, with features.
        meta: The metadata of the training data. With a conversion, its statistics must be those of
            the converted actions.
        conversion: The conversion that the processors do, if any.
    """
    before, after = make_pre_post_processors(
        config, dataset_stats=usable_statistics(meta.stats), dataset_meta=meta
    )
    if conversion is not None:
        add_steps(before, after, conversion)
    if config.env_state_feature is not None and not all(config.env_state_feature.shape):
        before.steps = [JointsAloneStep(), *before.steps]
    return before, after


def load_processors(
    checkpoint: Checkpoint, config: PreTrainedConfig, *, trust: bool = False, learns: bool = False
) -> tuple[Any, Any]:
    """Return the pre- and postprocessor of a checkpoint, on the configuration's device.

    Also raises what LeRobot raises.

    Args:
        checkpoint: The checkpoint.
        config: The policy's options, with the device.
        trust: Whether to load models that the processors name.
        learns: Whether a fit continues from the checkpoint.

    Raises:
        ManipError: The policy or its processors name models that are not trusted.
    """
    checkpoint.require_trust(trust)
    names = [step["registry_name"] for step in checkpoint.processors.get(PROCESSORS[0], ())]
    overrides = {
        _DEVICE_STEP: {"device": config.device},
        **({MEASURED: {"converted": True}} if learns else {}),
    }
    kept = {name: values for name, values in overrides.items() if name in names}
    return make_pre_post_processors(config, str(checkpoint.path), preprocessor_overrides=kept)


def usable_statistics(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, dict[str, Any]]:
    """Return a dataset's statistics with lower bounds on the deviations and ranges of vectors.

    Otherwise a joint that hardly moved in the data would be many deviations off as soon as it
    moves.
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


def load_policy(
    checkpoint: Checkpoint, device: str, trust: bool = False
) -> tuple[PreTrainedPolicy, Any, Any]:
    """Return the policy of a checkpoint, and its pre- and postprocessor.

    Downloads only what a trusted policy names.

    Args:
        checkpoint: The checkpoint.
        device: Torch's name for the device.
        trust: Whether to load models and code that the checkpoint names.

    Raises:
        UnknownName: The type of policy is unknown.
        ManipError: Packages are missing, the policy names models that are not trusted, or LeRobot
            cannot load the folder.
    """
    cls = policy_class(checkpoint.kind)
    checkpoint.require_trust(trust)
    with _lerobot(f"{checkpoint.path}: LeRobot cannot load it"):
        # not `PreTrainedConfig.from_pretrained`, which leaves a temporary file behind each time
        config = draccus.decode(cls, checkpoint.options | {"device": device})
        processors = load_processors(checkpoint, config, trust=trust)
        policy = get_policy_class(checkpoint.kind).from_pretrained(
            checkpoint.path, config=config, strict=True
        )
        return policy, *processors


@contextlib.contextmanager
def _lerobot(what: str) -> Iterator[None]:
    """Like `in_one_line`.

    Also drops what LeRobot prints, as standard output belongs to the caller.
    """
    with in_one_line(what), contextlib.redirect_stdout(io.StringIO()), warnings.catch_warnings():
        # of policies that see only joints
        warnings.filterwarnings("ignore", "Initializing zero-element tensors")
        yield
