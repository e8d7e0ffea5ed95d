"""What a `pretrained_model` folder says of itself, read before anything in it is loaded."""

from __future__ import annotations

import json
import math
import os
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_PICKLES = (".bin", ".pt", ".pth", ".pkl", ".pickle", ".ckpt")
_PLACEHOLDER = "empty_camera_"  # of LeRobot's language policies: they fill such a picture in themselves


@dataclass(frozen=True)
class Interface:
    """What a policy sees and gives.

    type: LeRobot's name for the policy. numbers: column -> how many; pictures: camera -> (height, width) [pixels];
    action: how many numbers.
    """

    type: str
    numbers: dict[str, int]
    pictures: dict[str, tuple[int, int]]
    action: int

    @property
    def columns(self) -> tuple[str, ...]:
        """All inputs by LeRobot's names."""
        return (*self.numbers, *(IMAGES + camera for camera in self.pictures))


def read_config(path: Path) -> dict[str, Any]:
    """`config.json` of a folder that is whole and holds no pickle; else `ManipError`."""
    if not (path / CONFIG).is_file():
        raise ManipError(f"no {CONFIG} in {path}; expected LeRobot's pretrained_model folder")
    for file in sorted(path.rglob("*")):
        if file.suffix.lower() in _PICKLES:
            raise ManipError(
                f"{file} is a pickle, which may run any code when it is read: convert it to safetensors and remove it"
            )
    if not (path / WEIGHTS).is_file():
        adapter = (path / "adapter_model.safetensors").is_file()
        hint = "it is an adapter: merge it into its base policy first" if adapter else "the weights are missing"
        raise ManipError(f"no {WEIGHTS} in {path}; {hint}")
    for name in (CONFIG, WEIGHTS):
        if not os.access(path / name, os.R_OK):
            raise ManipError(f"{path / name} may not be read by this user (uid {os.getuid()}); run as its owner")
    try:
        config = json.loads((path / CONFIG).read_text())
        _ = config["type"], config["input_features"].items(), config["output_features"].items()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ManipError(f"{path / CONFIG} is not a LeRobot policy's: {type(error).__name__}: {error}") from error
    return config


def read_interface(path: Path) -> Interface:
    """What the policy in a folder sees and gives. Raises what `read_config` raises."""
    return interface_of(read_config(path), path)


def interface_of(config: dict[str, Any], path: Path) -> Interface:
    """The same from `config.json`; path: for the message."""
    try:
        inputs = {key: (ft["type"], tuple(ft["shape"])) for key, ft in config["input_features"].items()}
        pictures = {key.removeprefix(IMAGES): shape for key, (kind, shape) in inputs.items() if kind == "VISUAL"}
        return Interface(
            type=config["type"],
            numbers={key: math.prod(shape) for key, (kind, shape) in inputs.items() if kind in ("STATE", "ENV")},
            pictures={name: (h, w) for name, (_, h, w) in pictures.items() if not name.startswith(_PLACEHOLDER)},
            action=math.prod(config["output_features"][ACTION]["shape"]),
        )
    except (KeyError, TypeError, ValueError) as error:
        raise ManipError(
            f"{path / CONFIG} has features that cannot be read: {type(error).__name__}: {error}"
        ) from error


def check_interface(interface: Interface, spec: RobotTaskSpec) -> None:
    """Raise `MismatchError` naming both sides unless an environment of `spec` has every input and takes the action."""
    who = f"{spec.robot}/{spec.task}"
    have = {STATE: len(spec.joint_names), ENVIRONMENT_STATE: len(spec.environment_state_names)}
    known = [*have, *spec.image_keys]
    if any(key not in known for key in interface.columns):
        raise MismatchError("inputs", "the policy", ", ".join(interface.columns), who, ", ".join(known))
    for key, width in interface.numbers.items():
        if width != have[key]:
            raise MismatchError(f"width of {key}", "the policy", width, who, have[key])
    if interface.action != have[STATE]:
        raise MismatchError("width of the action", "the policy", interface.action, who, have[STATE])
    for camera, size in interface.pictures.items():
        if size != spec.image_size:
            raise MismatchError(f"size of the pictures of {camera}", "the policy", size, who, spec.image_size)


def check_processors(path: Path) -> None:
    """Refuse a step by import path: LeRobot would import and call whatever a downloaded file names."""
    for name in PROCESSORS:
        if not (path / name).is_file():
            raise ManipError(f"no {path / name}; LeRobot's migrate_policy_normalization adds it to an old checkpoint")
        for step in processor_steps(path / name):
            if "registry_name" not in step:
                raise ManipError(f"{path / name} wants to run {step.get('class')!r}; only registered steps are loaded")


def processor_steps(path: Path) -> list[dict[str, Any]]:
    """The steps that a processor's file names."""
    try:
        return [dict(step) for step in json.loads(path.read_text()).get("steps", [])]
    except (ValueError, TypeError, AttributeError) as error:
        raise ManipError(f"{path} cannot be read: {error}") from error
