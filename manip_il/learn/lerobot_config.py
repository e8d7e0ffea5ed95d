"""LeRobot's configurations (policy, optimiser, schedule, ...) from the options that a user gave, by LeRobot's names."""

from __future__ import annotations

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
from draccus.utils import DecodingError, ParsingError
from lerobot.configs import NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from manip_il.data.schema import ACTION, JOINT_TARGETS, OPENINGS
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.learn.checkpoint import Checkpoint, require_trust
from manip_il.learn.fit_config import FitConfig, check_convertible
from manip_il.learn.names import JOINT_TARGET, OWN_SPACE

PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")
# Where a policy's configuration is kept with what was meant for one machine or one command.
NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")


@cache
def policy_types() -> tuple[str, ...]:
    """Return every `--policy.type` that LeRobot and this project know."""
    for module in ("lerobot.policies", *PLUGINS):
        importlib.import_module(module)
    return tuple(sorted(PreTrainedConfig.get_known_choices()))


def policy_class(kind: str) -> type[PreTrainedConfig]:
    """Return the configuration class of a policy type; `UnknownName` for another."""
    policy_types()
    return _registered(PreTrainedConfig, kind, "policy")


def _registered(base: type[Any], kind: Any, what: str) -> Any:
    known = sorted(base.get_known_choices())
    if kind not in known:
        raise UnknownName(what, str(kind), known)
    return base.get_choice_class(kind)


def policy_config(fit: FitConfig) -> PreTrainedConfig:
    """Return the configuration of the policy of a fit: new, or that of the checkpoint to start from, changed.

    The device is the graphics card if there is one. Raises `UnknownName` for a type or an option that is not there,
    `UsageError` for a value that LeRobot refuses, `ManipError` if models are named that would have to be trusted.
    """
    given = {name: value for name, value in fit.policy.items() if name not in ("type", "path")}
    if str(given.get("device")).startswith("cuda") and not torch.cuda.is_available():  # LeRobot takes another
        raise UsageError(f"--policy.device={given['device']}, but torch sees no graphics card here; expected cpu")
    given.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
    source, options = f"--policy.type={fit.kind}", dict(given)
    cls = policy_class(fit.kind)
    if fit.start is not None:
        source, saved = f"--policy.path={fit.start.path}", fit.start.config
        options = {name: value for name, value in saved.items() if name not in ("type", *NOT_OURS)}
        if "pretrained_backbone_weights" in saved:  # they are in the checkpoint; torchvision would download its own
            options["pretrained_backbone_weights"] = None
        options |= given
    require_trust({**options, "type": fit.kind}, source, fit.trust)
    config = typing.cast(PreTrainedConfig, decode(cls, options, source))
    config.push_to_hub = False  # LeRobot's default is to upload; here nothing leaves the machine unasked
    start = fit.init_from or (fit.start.path if fit.start else None)
    config.pretrained_path = None if start is None else Path(start)
    return config


def choice(base: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """Return one of the configurations registered under `base`, by `settings["type"]`: an optimiser, a schedule."""
    own = {name: value for name, value in settings.items() if name != "type"}
    cls = _registered(base, settings.get("type"), f"--{group}.type")
    return decode(cls, own, f"--{group}.type={settings.get('type')}")


def decode(cls: type[Any], settings: Mapping[str, Any], source: str) -> Any:
    """Return a dataclass of LeRobot's from options by name; `UsageError` for what it refuses. source: of them."""
    known = [field.name for field in dataclasses.fields(cls) if field.init and field.name not in NOT_OURS]
    for name in settings:
        if name not in known:
            raise UnknownName(f"option of {source}:", name, known)
    try:
        return draccus.decode(cls, dict(settings))
    except (DecodingError, ParsingError, ValueError, TypeError, NotImplementedError, ImportError) as error:
        reason = error if isinstance(error, DecodingError) else error.__cause__ or error
        raise UsageError(f"{source}: {' '.join(str(reason).split())}") from error


def option_lines(kind: str) -> list[tuple[str, str]]:
    """List name and default of every option of a policy type, for the help."""
    rows = []
    for field in dataclasses.fields(policy_class(kind)):
        if not field.init or field.name in (*NOT_OURS, "input_features", "output_features"):
            continue
        missing = field.default is dataclasses.MISSING
        default = field.default_factory() if missing and callable(field.default_factory) else field.default
        rows.append((f"--policy.{field.name}", _printed(default)))
    return rows


def _printed(value: Any) -> str:
    """The default as a user would type it."""
    return json.dumps(draccus.encode(value)).replace('"', "")


def policy_features(
    features: Mapping[str, dict[str, Any]], inputs: Sequence[str]
) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Return LeRobot's input and output features of a policy, from the `features` of `info.json`.

    Pictures, (H, W, 3) in the table, are (3, H, W) for a policy.
    """
    typed = dataset_to_policy_features({key: features[key] for key in (*inputs, ACTION)})
    typed = {key: PolicyFeature(feature.type, tuple(feature.shape)) for key, feature in typed.items()}
    return {key: typed[key] for key in inputs}, {ACTION: typed[ACTION]}


def set_features(
    policy: PreTrainedConfig, features: Mapping[str, dict[str, Any]], inputs: Sequence[str], observation: str
) -> None:
    """Give a policy its inputs and outputs, from a dataset's features.

    LeRobot's policies for states leave `observation.environment_state` in its raw units unless told otherwise: here
    it is normalised as the joint state is. Raises `ManipError` for what the policy refuses.
    """
    policy.input_features, policy.output_features = policy_features(features, inputs)
    modes: dict[str, NormalizationMode] = getattr(policy, "normalization_mapping", {})
    if "STATE" in modes:
        modes.setdefault("ENV", modes["STATE"])
    try:
        policy.validate_features()
    except ValueError as error:
        raise ManipError(f"--policy.type={policy.type} with --observation={observation}: {error}") from error


def lerobot_options(fit: FitConfig, action_meaning: str = OPENINGS) -> tuple[TrainPipelineConfig, str]:
    """Return a fit's options as LeRobot has them (policy, optimiser, schedule, logger, ...), and its action space.

    They are what LeRobot writes as `train_config.json`, but for the dataset and the folder, which are not known yet.
    action_meaning: of the data's numbers; if they are no joint targets, they are learnt as they are by default. Raises
    what `policy_config` raises, `UnknownName` or `UsageError` for an optimiser, a schedule or a logger that LeRobot
    does not know, `MismatchError` for a checkpoint to start from that has learnt in another action space.
    """
    policy = policy_config(fit)
    space = _action_space(policy, fit, action_meaning)
    optimizer = choice(OptimizerConfig, fit.optimizer, "optimizer") if fit.optimizer else policy.get_optimizer_preset()
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
        scheduler=choice(LRSchedulerConfig, fit.scheduler, "scheduler")
        if fit.scheduler
        else policy.get_scheduler_preset(),
        wandb=decode(WandBConfig, fit.wandb, "--wandb"),
    )
    return pipeline, space


def _action_space(policy: PreTrainedConfig, fit: FitConfig, meaning: str) -> str:
    """The action space of a fit, also put into the configuration of a policy that has it there."""
    wanted = fit.action_space
    if wanted is None and "action_space" not in fit.policy and meaning not in JOINT_TARGETS:
        wanted = JOINT_TARGET
    start = fit.start or (Checkpoint.open(fit.init_from) if fit.init_from else None)
    space = wanted or getattr(policy, "action_space", start.space if start else JOINT_TARGET)
    if start is not None and start.space != space:
        raise MismatchError("action space", f"the checkpoint {start.path}", start.space, "this fit", space)
    check_convertible(policy.type, space)
    if policy.type in OWN_SPACE:
        vars(policy)["action_space"] = space
    return space
