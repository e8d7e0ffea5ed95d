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

from manip_il.errors import ManipError, UnknownName, UsageError

# Where a policy's configuration is kept with what was meant for one machine or one command.
_NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")
PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")


@cache
def policy_types() -> tuple[str, ...]:
    """Every `--policy.type` that LeRobot and this project know."""
    for module in ("lerobot.policies", *PLUGINS):
        importlib.import_module(module)
    return tuple(sorted(PreTrainedConfig.get_known_choices()))


def policy_class(kind: str) -> type[PreTrainedConfig]:
    """The configuration class of a policy type; `UnknownName` for another."""
    if kind not in policy_types():
        raise UnknownName("policy", kind, policy_types())
    return PreTrainedConfig.get_choice_class(kind)


def policy_config(settings: Mapping[str, Any], default_type: str = "mlp") -> PreTrainedConfig:
    """The configuration that `--policy.*` asks for: of `type`, or of the checkpoint in `path`, with the rest changed.

    The device is the graphics card where there is one. Raises `UnknownName` for a type or an option that is not
    there, `UsageError` for a value that LeRobot refuses, `ManipError` for a `path` without a policy.
    """
    settings = dict(settings)
    if str(settings.get("device")).startswith("cuda") and not torch.cuda.is_available():  # LeRobot takes another
        raise UsageError(f"--policy.device={settings['device']}, but torch sees no graphics card here; expected cpu")
    settings.setdefault("device", "cuda" if torch.cuda.is_available() else "cpu")
    if "path" in settings:
        return _from_checkpoint(Path(settings.pop("path")), settings)
    kind = settings.pop("type", default_type)
    return _checked(typing.cast(PreTrainedConfig, _decode(policy_class(kind), settings, f"--policy.type={kind}")))


def _from_checkpoint(path: Path, settings: dict[str, Any]) -> PreTrainedConfig:
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: a checkpoint knows its type")
    policy_types()
    if not (path / "config.json").is_file():
        raise ManipError(f"no config.json in {path}; --policy.path wants LeRobot's pretrained_model folder")
    with _quiet():
        config = PreTrainedConfig.from_pretrained(path, local_files_only=True)
    encoded = typing.cast(dict[str, Any], draccus.encode(config))
    kept = {key: value for key, value in encoded.items() if key not in ("type", *_NOT_OURS)}
    config = _checked(typing.cast(PreTrainedConfig, _decode(type(config), kept | settings, f"--policy.path={path}")))
    config.pretrained_path = path
    return config


def _checked(config: PreTrainedConfig) -> PreTrainedConfig:
    config.push_to_hub = False  # LeRobot's default is to upload; here nothing leaves the machine unasked
    return config


def choice(base: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """One of the configurations registered under `base`, by `settings["type"]`: an optimiser, a schedule."""
    settings = dict(settings)
    known = sorted(base.get_known_choices())
    kind = settings.pop("type", None)
    if kind not in known:
        raise UnknownName(f"--{group}.type", str(kind), known)
    return _decode(base.get_choice_class(kind), settings, f"--{group}.type={kind}")


def plain(cls: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """A configuration without types, `WandBConfig` for instance."""
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
    except (DecodingError, ParsingError, ValueError, TypeError, NotImplementedError) as error:
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
