"""LeRobot's configurations (policy, optimiser, schedule, ...) from the options that a user gave, by LeRobot's names."""

from __future__ import annotations

import dataclasses
import importlib
import logging
import typing
from collections.abc import Mapping
from contextlib import contextmanager
from enum import Enum
from functools import cache
from pathlib import Path
from typing import Any

import draccus
import torch
from draccus.utils import DecodingError, ParsingError
from lerobot.configs import PreTrainedConfig

from manip_il.errors import UnknownName, UsageError
from manip_il.learn.limits import check_numbers
from manip_il.learn.pretrained import CONFIG, read_config
from manip_il.learn.trust import PLAIN, require_trust

# Where a policy's configuration is kept with what was meant for one machine or one command.
_NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")
PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")


@cache
def policy_types() -> tuple[str, ...]:
    """Return every `--policy.type` that LeRobot and this project know."""
    for module in ("lerobot.policies", *PLUGINS):
        importlib.import_module(module)
    return tuple(sorted(PreTrainedConfig.get_known_choices()))


def policy_class(kind: str) -> type[PreTrainedConfig]:
    """Return the configuration class of a policy type; `UnknownName` for another."""
    if kind not in policy_types():
        raise UnknownName("policy", kind, policy_types())
    return PreTrainedConfig.get_choice_class(kind)


def policy_config(settings: Mapping[str, Any], default_type: str = "mlp", *, trust: bool = False) -> PreTrainedConfig:
    """Return the configuration that `--policy.*` asks for.

    Of `type`, or of the checkpoint in `path`, with the rest changed.

    The device is the graphics card where there is one. As many actions are taken of a plan as it has, where LeRobot's
    default is more. trust: whether models that the configuration names may be loaded. Raises `UnknownName` for a type
    or an option that is not there, `UsageError` for a value that LeRobot refuses, `ManipError` for a `path` without a
    policy and where trust is needed.
    """
    settings = dict(settings)
    if str(settings.get("device")).startswith("cuda") and not torch.cuda.is_available():  # LeRobot takes another
        raise UsageError(f"--policy.device={settings['device']}, but torch sees no graphics card here; expected cpu")
    settings.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
    if "path" in settings:
        return _from_checkpoint(Path(settings.pop("path")), settings, trust)
    kind = settings.pop("type", default_type)
    cls, where = policy_class(kind), f"--policy.type={kind}"
    require_trust({**settings, "type": kind}, where, trust)
    return _checked(typing.cast(PreTrainedConfig, _decode(cls, _fitting(cls, settings, settings), where)))


def _from_checkpoint(path: Path, settings: dict[str, Any], trust: bool) -> PreTrainedConfig:
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: the type is in the checkpoint")
    saved = read_config(path)
    cls, where = policy_class(saved["type"]), f"--policy.path={path}"
    require_trust(saved | settings, where, trust)
    if saved["type"] in PLAIN:
        check_numbers(saved, str(path / CONFIG))
    # The weights are in the checkpoint; torchvision would download its own first.
    unused = ("type", "pretrained_backbone_weights", *_NOT_OURS)
    kept = {key: value for key, value in saved.items() if key not in unused}
    if "pretrained_backbone_weights" in saved:
        kept["pretrained_backbone_weights"] = None
    options = _fitting(cls, kept | settings, settings)
    config = _checked(typing.cast(PreTrainedConfig, _decode(cls, options, where)))
    config.pretrained_path = path
    return config


def _fitting(cls: type[Any], options: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, Any]:
    """Options with no more `n_action_steps` than a plan has, unless the user gave that number."""
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    values = defaults | dict(options)
    wanted = values.get("n_action_steps")
    plan = next((values[name] for name in ("chunk_size", "action_horizon", "horizon") if name in defaults), None)
    if "n_action_steps" in given or not isinstance(wanted, int) or not isinstance(plan, int):
        return dict(options)
    if "horizon" in defaults:  # a plan that begins with the first observation
        plan -= max(0, values["n_obs_steps"] - 1) if isinstance(values["n_obs_steps"], int) else 0
    return {**options, "n_action_steps": plan} if 1 <= plan < wanted else dict(options)


def _checked(config: PreTrainedConfig) -> PreTrainedConfig:
    config.push_to_hub = False  # LeRobot's default is to upload; here nothing leaves the machine unasked
    return config


def choice(base: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """Return one of the configurations registered under `base`, by `settings["type"]`: an optimiser, a schedule."""
    settings = dict(settings)
    known = sorted(base.get_known_choices())
    kind = settings.pop("type", None)
    if kind not in known:
        raise UnknownName(f"--{group}.type", str(kind), known)
    return _decode(base.get_choice_class(kind), settings, f"--{group}.type={kind}")


def plain(cls: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """Return a configuration without types, `WandBConfig` for instance."""
    return _decode(cls, dict(settings), f"--{group}")


def option_lines(cls: type[Any], group: str) -> list[tuple[str, str]]:
    """Name and default of every option of a configuration class, for the help."""
    rows = []
    for field in dataclasses.fields(cls):
        if not field.init or field.name in (*_NOT_OURS, "input_features", "output_features"):
            continue
        missing = field.default is dataclasses.MISSING
        default = field.default_factory() if missing and callable(field.default_factory) else field.default
        rows.append((f"--{group}.{field.name}", _shown(default)))
    return rows


def _shown(value: Any) -> str:
    """A default as it would be given."""
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_shown(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_shown, value)) + "]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _decode(cls: type[Any], settings: Mapping[str, Any], where: str) -> Any:
    known = [field.name for field in dataclasses.fields(cls) if field.init and field.name not in _NOT_OURS]
    for name in settings:
        if name not in known:
            raise UnknownName(f"option of {where}:", name, known)
    try:
        with _quiet():
            return draccus.decode(cls, settings)
    except (DecodingError, ParsingError, ValueError, TypeError, NotImplementedError, ImportError) as error:
        reason = error if isinstance(error, DecodingError) else error.__cause__ or error
        raise UsageError(f"{where}: {' '.join(str(reason).split())}") from error


@contextmanager
def _quiet():
    """LeRobot warns of the device that it looks for before it knows which one is asked for."""
    logger = logging.getLogger("lerobot.configs.policies")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)
