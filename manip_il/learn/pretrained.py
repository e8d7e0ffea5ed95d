"""What a `pretrained_model` folder says of itself, read before anything in it is loaded."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError

CONFIG, WEIGHTS = "config.json", "model.safetensors"
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_PICKLES = (".bin", ".pt", ".pth", ".pkl", ".pickle", ".ckpt")
_LARGEST_JSON = 16 * 1024 * 1024  # [bytes]
_MOST_FEATURES, _MOST_STEPS, _LONGEST_SIDE = 100, 100, 100_000
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
    config = checks.read_json(path / CONFIG, "a LeRobot policy's config.json", _LARGEST_JSON)
    try:
        checks.text("type", config.get("type"), checks.LONGEST_NAME)
        for features in ("input_features", "output_features"):
            checks.mapping(features, config.get(features))
    except ManipError as error:
        raise ManipError(f"{path / CONFIG} is not a LeRobot policy's: {error}") from error
    return config


def read_interface(path: Path) -> Interface:
    """What the policy in a folder sees and gives. Raises what `read_config` raises."""
    return interface_of(read_config(path), path)


def interface_of(config: dict[str, Any], path: Path) -> Interface:
    """Return the same from `config.json`; path: for the message."""
    try:
        inputs, outputs = _features(config["input_features"]), _features(config["output_features"])
        if ACTION not in outputs:
            raise ManipError(f"no {ACTION} among the outputs ({', '.join(outputs)})")
        pictures = {key.removeprefix(IMAGES): shape for key, (kind, shape) in inputs.items() if kind == "VISUAL"}
        if any(len(shape) != 3 for shape in pictures.values()):
            raise ManipError(f"pictures of shapes {checks.shorten(list(pictures.values()))}; expected (3, H, W)")
        return Interface(
            type=config["type"],
            numbers={key: math.prod(shape) for key, (kind, shape) in inputs.items() if kind in ("STATE", "ENV")},
            pictures={name: shape[1:] for name, shape in pictures.items() if not name.startswith(_PLACEHOLDER)},  # pyright: ignore[reportArgumentType]
            action=math.prod(outputs[ACTION][1]),
        )
    except ManipError as error:
        raise ManipError(f"{path / CONFIG} has features that cannot be read: {error}") from error


def _features(features: Mapping[str, Any]) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Name -> kind and shape of a policy's inputs or outputs."""
    if len(features) > _MOST_FEATURES:
        raise ManipError(f"{len(features)} features; expected at most {_MOST_FEATURES}")
    found: dict[str, tuple[str, tuple[int, ...]]] = {}
    for key, value in features.items():
        checks.text("name of a feature", key, checks.LONGEST_NAME)
        feature = checks.mapping(key, value)
        shape = checks.array(f"shape of {key}", feature.get("shape"), 4)
        sides = tuple(checks.whole(f"a side of {key}", side, 1, _LONGEST_SIDE) for side in shape)
        found[key] = checks.text(f"type of {key}", feature.get("type"), checks.LONGEST_NAME), sides
    return found


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
    """Raise `ManipError` unless both processors' files can be read; see `processor_steps`."""
    for name in PROCESSORS:
        if not (path / name).is_file():
            raise ManipError(f"no {path / name}; LeRobot's migrate_policy_normalization adds it to an old checkpoint")
        processor_steps(path / name)


def processor_steps(path: Path) -> list[dict[str, Any]]:
    """Return the steps that a processor's file names: each `registry_name`, `config` and perhaps `state_file`.

    Refuses a step by import path, as LeRobot would import and call whatever a downloaded file names, and a state
    outside of the folder.
    """
    values = checks.read_json(path, "a processor of LeRobot's", _LARGEST_JSON)
    try:
        steps = [checks.mapping("a step", step) for step in checks.array("steps", values.get("steps"), _MOST_STEPS)]
        return [_step(path, step) for step in steps]
    except ManipError as error:
        raise ManipError(f"{path} cannot be read: {error}") from error


def _step(path: Path, step: dict[str, Any]) -> dict[str, Any]:
    if "registry_name" not in step:
        raise ManipError(f"it asks to run {checks.shorten(step.get('class'))}; only registered steps are loaded")
    known = {
        "registry_name": checks.text("registry_name", step["registry_name"], checks.LONGEST_NAME),
        "config": checks.mapping("config", step.get("config", {})),
    }
    if "state_file" in step:
        known["state_file"] = checks.name("state_file", step["state_file"])
        if not (path.parent / known["state_file"]).is_file():
            raise ManipError(f"no {known['state_file']} beside it")
    return known
