"""LeRobot's configurations (policy, optimiser, schedule, ...), built from the user's options."""

import dataclasses
import importlib
import json
import typing
from collections.abc import Mapping, Sequence
from functools import cache
from pathlib import Path
from typing import Any

import draccus
import torch
from draccus.utils import DecodingError
from lerobot.configs import FeatureType, NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.learn.checkpoint import require_trust
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import CONVERTED, JOINT_TARGET, OWN_SPACE
from manip_il.learn.network import require_device
from manip_il.worlds.contract import JOINT_TARGETS, OPENINGS

PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")
# Options of LeRobot's policies that concern its Hub, its commands or one machine, and one without
# effect.
NOT_OURS = (
    *("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft"),
    "heatmap_weight",
)


@cache
def policy_types() -> tuple[str, ...]:
    """Return every `--policy.type` that LeRobot and this project know."""
    for module in ("lerobot.policies", *PLUGINS):
        importlib.import_module(module)
    return tuple(sorted(PreTrainedConfig.get_known_choices()))


def policy_class(kind: str) -> type[PreTrainedConfig]:
    """Return the configuration class of a policy type.

    Raises:
        UnknownName: The type is unknown.
    """
    policy_types()
    return _registered(PreTrainedConfig, kind, "policy")


def _registered(base: type[Any], kind: Any, what: str) -> Any:
    known = sorted(base.get_known_choices())
    if kind not in known:
        raise UnknownName(what, str(kind), known)
    return base.get_choice_class(kind)


def policy_config(fit: FitConfig) -> PreTrainedConfig:
    """Return the policy configuration of a fit: new, or that of the initial checkpoint with
    changes.

    The device is the GPU if there is one.

    Raises:
        UnknownName: The policy's type or an option is unknown.
        UsageError: LeRobot refuses a value, PyTorch does not find the device, or the initial
            checkpoint needs its dataset of states again.
        ManipError: The policy names models that are not trusted.
    """
    cls = policy_class(fit.kind)
    source, saved = f"--policy.type={fit.kind}", dict[str, Any]()
    given = {name: value for name, value in fit.policy.items() if name not in ("type", "path")}
    given.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
    require_device(str(given["device"]))  # LeRobot would switch devices
    if fit.start is not None:
        source = f"--policy.path={fit.start.path}"
        saved = {name: value for name, value in fit.start.options.items() if name not in NOT_OURS}
        # a dataset's path, which only the user may name
        if saved.get("states") and "states" not in given:
            raise UsageError(
                f"{source} learnt from a dataset of states; give it again with"
                " --policy.states=DATASET"
            )
    options = saved | given
    require_trust({**options, "type": fit.kind}, source, fit.trust)
    config = typing.cast(PreTrainedConfig, decode(cls, options, source))
    # LeRobot uploads by default; nothing leaves this machine unless asked to
    config.push_to_hub = False
    start = fit.init_from or (fit.start.path if fit.start else None)
    config.pretrained_path = None if start is None else Path(start)
    return config


def choice(base: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """Return the optimiser, schedule or other configuration that `settings` describes.

    Args:
        base: LeRobot's base class, with which the types are registered.
        settings: The `type`, and that type's options by name.
        group: The name of the options on the command line, such as `optimizer`, for messages.

    Raises:
        UnknownName: The type or an option is unknown.
        UsageError: LeRobot refuses a value.
    """
    own = {name: value for name, value in settings.items() if name != "type"}
    cls = _registered(base, settings.get("type"), f"--{group}.type")
    return decode(cls, own, f"--{group}.type={settings.get('type')}")


def decode(cls: type[Any], settings: Mapping[str, Any], source: str) -> Any:
    """Return a LeRobot dataclass built from its options.

    Args:
        cls: The dataclass.
        settings: The values of its options by name.
        source: Where the options come from, for messages.

    Raises:
        UnknownName: An option is unknown.
        UsageError: LeRobot refuses a value.
    """
    known = [
        field.name for field in dataclasses.fields(cls) if field.init and field.name not in NOT_OURS
    ]
    for name in settings:
        if name not in known:
            raise UnknownName(f"option of {source}:", name, known)
    try:
        return draccus.decode(cls, dict(settings))
    except Exception as error:
        reason = error if isinstance(error, DecodingError) else error.__cause__ or error
        raise UsageError(f"{source}: {' '.join(str(reason).split())}") from error


def option_lines(kind: str) -> list[tuple[str, str]]:
    """Return name and default of every option of a policy type, for the help."""
    rows = []
    for field in dataclasses.fields(policy_class(kind)):
        if not field.init or field.name in (*NOT_OURS, "input_features", "output_features"):
            continue
        missing = field.default is dataclasses.MISSING
        default = (
            field.default_factory()
            if missing and callable(field.default_factory)
            else field.default
        )
        typed = json.dumps(draccus.encode(default)).replace('"', "")  # as a user would type it
        rows.append((f"--policy.{field.name}", typed))
    return rows


def policy_features(
    features: Mapping[str, dict[str, Any]], inputs: Sequence[str]
) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Return LeRobot's input and output features of a policy, from the `features` of `info.json`.

    Pictures, (H, W, 3) in `info.json`, are (3, H, W) for a policy.
    """
    typed = dataset_to_policy_features({key: features[key] for key in (*inputs, ACTION)})
    return {key: typed[key] for key in inputs}, {ACTION: typed[ACTION]}


def set_features(
    policy: PreTrainedConfig,
    features: Mapping[str, dict[str, Any]],
    inputs: Sequence[str],
    observation: str,
) -> None:
    """Set a policy's inputs and outputs from a dataset's features.

    By default LeRobot's state-based policies leave `observation.environment_state` in its raw
    units; here it is normalised like the joint state. They refuse the joints alone, which get an
    environment state of no numbers, see `JointsAloneStep`.

    Args:
        policy: The policy's options, which are changed in place.
        features: The `features` of the dataset's `info.json`.
        inputs: The columns that the policy observes.
        observation: The value of `--observation`, for the message.

    Raises:
        ManipError: The policy refuses the features.
    """
    policy.input_features, policy.output_features = policy_features(features, inputs)
    if list(inputs) == [STATE] and policy.type not in OWN_SPACE:
        policy.input_features[ENVIRONMENT_STATE] = PolicyFeature(FeatureType.ENV, (0,))
    modes: dict[str, NormalizationMode] = getattr(policy, "normalization_mapping", {})
    if "STATE" in modes:
        modes.setdefault("ENV", modes["STATE"])
    try:
        policy.validate_features()
    except ValueError as error:
        raise ManipError(
            f"--policy.type={policy.type} with --observation={observation}: {error}"
        ) from error


def lerobot_options(
    fit: FitConfig, action_meaning: str = OPENINGS
) -> tuple[TrainPipelineConfig, str]:
    """Return a fit's options in LeRobot's form (policy, optimiser, schedule, logger, ...), and its
    action space.

    LeRobot writes these as `train_config.json`, apart from the dataset and the folder, which are
    not known yet.

    Args:
        fit: The options of the fit.
        action_meaning: As in the dataset; actions other than joint targets are by default learnt
            unchanged.

    Raises:
        UnknownName: The policy's type, the optimiser, the schedule or one of their options is
            unknown.
        UsageError: LeRobot refuses a value, or the policy does not support the action space.
        MismatchError: The initial checkpoint has another action space.
        ManipError: The policy names models that are not trusted.
    """
    policy = policy_config(fit)
    space = _action_space(policy, fit, action_meaning)
    optimizer = (
        choice(OptimizerConfig, fit.optimizer, "optimizer")
        if fit.optimizer
        else policy.get_optimizer_preset()
    )
    if fit.lr is not None:
        optimizer.lr = fit.lr
    pipeline = TrainPipelineConfig(
        dataset=DatasetConfig("local/none"),
        policy=policy,
        job_name=f"manip_il_{policy.type}",
        seed=fit.seed,
        batch_size=fit.batch_size or fit.defaults.batch_size,
        steps=fit.total_steps,
        env_eval_freq=0,
        log_freq=fit.log_freq,
        save_freq=fit.save_freq or fit.defaults.save_freq,
        optimizer=optimizer,
        scheduler=(
            choice(LRSchedulerConfig, fit.scheduler, "scheduler")
            if fit.scheduler
            else policy.get_scheduler_preset()
        ),
        wandb=decode(WandBConfig, fit.wandb, "--wandb"),
    )
    return pipeline, space


def _action_space(policy: PreTrainedConfig, fit: FitConfig, meaning: str) -> str:
    """Return the action space of a fit."""
    wanted = fit.action_space
    if wanted is None and "action_space" not in fit.policy and meaning not in JOINT_TARGETS:
        wanted = JOINT_TARGET
    start = fit.initial
    space = wanted or getattr(policy, "action_space", start.space if start else JOINT_TARGET)
    if start is not None and start.space != space:
        raise MismatchError(
            "action space", f"the checkpoint {start.path}", start.space, "this fit", space
        )
    if space != JOINT_TARGET and policy.type not in CONVERTED:
        raise UsageError(
            f"action_space is {space!r}, which --policy.type={policy.type} does not support;"
            f" expected {JOINT_TARGET}, or --policy.type={', '.join(CONVERTED[:-1])} or"
            f" {CONVERTED[-1]}"
        )
    return space
