"""A `pretrained_model` folder's own files, checked before anything in it is loaded: a checkpoint is data from anywhere.

LeRobot's language and vision policies load tokenizers, encoders and whole models that the checkpoint names, some with
`trust_remote_code`, which runs Python from the named repository. Policies that are built from their own configuration
and weights alone are listed in `PLAIN`, the steps of their processors in `_STEPS`; all others need `--trust=true`.
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UnknownName
from manip_il.learn.fit_config import ACTION_SPACES, EE_DELTA, JOINT_DELTA, JOINT_TARGET, OWN_SPACE

CONFIG, WEIGHTS = "config.json", "model.safetensors"
OBSERVATIONS = ("state", "images", "both")  # besides the joints: the true poses, pictures, or both
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_PICKLES = (".bin", ".pt", ".pth", ".pkl", ".pickle", ".ckpt")
_LARGEST_JSON = 16 * 1024 * 1024  # [bytes]
_MOST_FEATURES, _MOST_STEPS, _LONGEST_SIDE = 100, 100, 100_000
_PLACEHOLDER = "empty_camera_"  # of LeRobot's language policies: they fill such a picture in themselves
_NORMALISER = frozenset({"eps", "features", "norm_map", "normalize_observation_keys"})
MEASURED, DECODER = "manip_il_measured_joints", "manip_il_joint_targets"  # steps that carry an action space
_STEPS: dict[str, frozenset[str]] = {  # LeRobot's default processors, and ours: step -> the options that it may have
    "rename_observations_processor": frozenset({"rename_map"}),
    "to_batch_processor": frozenset(),
    "device_processor": frozenset({"device", "float_dtype"}),
    "normalizer_processor": _NORMALISER,
    "unnormalizer_processor": _NORMALISER,
    MEASURED: frozenset(),
    DECODER: frozenset({"action_space", "robot"}),
}
PLAIN = ("act", "cnn", "diffusion", "gaussian_actor", "mlp", "tdmpc", "vqbet")  # policies that load nothing by name
_NAMES: dict[str, tuple[str, ...]] = {  # other policies of LeRobot 0.6.1 -> the options that name what they load
    "eo1": ("vlm_base",),
    "evo1": ("vlm_model_name",),
    "fastwam": ("model_id", "base_model_id", "text_encoder_model_id", "tokenizer_model_id"),
    "gaussian_actor": ("vision_encoder_name",),  # plain without one
    "groot": ("base_model_path", "tokenizer_assets_repo"),
    "lingbot_va": ("wan_pretrained_path",),
    "molmoact2": ("checkpoint_path", "discrete_action_tokenizer"),
    "multi_task_dit": ("vision_encoder_name", "text_encoder_name"),
    "pi0_fast": ("text_tokenizer_name", "action_tokenizer_name"),
    "smolvla": ("vlm_model_name",),
    "vla_jepa": ("qwen_model_name", "jepa_encoder_name"),
    "wall_x": ("pretrained_name_or_path", "action_tokenizer_path"),
    "xvla": ("tokenizer_name",),
}


_MLP_SHAPE = ("width", "depth", "activation", "loss", "components", "bins", "clamp")


@dataclass(frozen=True)
class Interface:
    """Inputs and outputs of a policy.

    type: LeRobot's name for the policy. numbers: column -> how many; pictures: camera -> (height, width) [pixels];
    action: how many numbers. space: the action space it has learnt in; robot: whose hand moves, for `ee_delta` alone.
    """

    type: str
    numbers: dict[str, int]
    pictures: dict[str, tuple[int, int]]
    action: int
    space: str = JOINT_TARGET
    robot: str = ""

    @property
    def columns(self) -> tuple[str, ...]:
        """All inputs by LeRobot's names."""
        return (*self.numbers, *(IMAGES + camera for camera in self.pictures))


def observation_of(input_features: Iterable[str]) -> str:
    """Return which of `OBSERVATIONS` a policy takes, from the names of its inputs."""
    keys = set(input_features)
    if not any(key.startswith(IMAGES) for key in keys):
        return "state"
    return "both" if ENVIRONMENT_STATE in keys else "images"


def read_config(path: Path) -> dict[str, Any]:
    """Return the `config.json` of a folder that is whole and holds no pickle; else raise `ManipError`."""
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
    """Return inputs and outputs of the policy in a folder. Raises what `read_config` raises."""
    return interface_of(read_config(path), path)


def mlp_options(path: Path) -> dict[str, Any] | None:
    """Return the options of another mlp of the architecture in a folder; None where it holds another kind of policy.

    Raises what `read_config` raises.
    """
    config = read_config(path)
    if config["type"] != "mlp":
        return None
    kept = {name: config[name] for name in _MLP_SHAPE if name in config}
    return {"type": "mlp", **kept, "sigma": config.get("sigma", 0.0)}


def interface_of(config: dict[str, Any], path: Path) -> Interface:
    """Return inputs and outputs from a `config.json`; path: for the message."""
    try:
        inputs, outputs = _features(config["input_features"]), _features(config["output_features"])
        if ACTION not in outputs:
            raise ManipError(f"no {ACTION} among the outputs ({', '.join(outputs)})")
        space, robot = _space(config, path)
        pictures = {key.removeprefix(IMAGES): shape for key, (kind, shape) in inputs.items() if kind == "VISUAL"}
        if any(len(shape) != 3 for shape in pictures.values()):
            raise ManipError(f"pictures of shapes {checks.shorten(list(pictures.values()))}; expected (3, H, W)")
        return Interface(
            type=config["type"],
            numbers={key: math.prod(shape) for key, (kind, shape) in inputs.items() if kind in ("STATE", "ENV")},
            pictures={name: shape[1:] for name, shape in pictures.items() if not name.startswith(_PLACEHOLDER)},  # pyright: ignore[reportArgumentType]
            action=math.prod(outputs[ACTION][1]),
            space=space,
            robot=robot,
        )
    except ManipError as error:
        raise ManipError(f"{path / CONFIG} has features that cannot be read: {error}") from error


def _space(config: Mapping[str, Any], path: Path) -> tuple[str, str]:
    """Action space and robot: the mlp's and cnn's by their configuration, all others' by the postprocessor's step."""
    file = path / PROCESSORS[1]
    steps = processor_steps(file) if file.is_file() else []
    options: dict[str, Any] = next((one["config"] for one in steps if one["registry_name"] == DECODER), {})
    converted, robot = options.get("action_space", JOINT_TARGET), checks.text("robot", options.get("robot", ""))
    if config["type"] not in OWN_SPACE:
        return _known_space(converted), robot
    space = _known_space(config.get("action_space", JOINT_DELTA))
    if converted != (in_step := EE_DELTA if space == EE_DELTA else JOINT_TARGET):
        raise MismatchError(f"action space, for {space},", file.name, converted, CONFIG, in_step)
    return space, robot


def _known_space(space: Any) -> str:
    if checks.text("action_space", space, checks.LONGEST_NAME) not in ACTION_SPACES:
        raise UnknownName("action space", space, ACTION_SPACES)
    return space


def _features(features: Mapping[str, Any]) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Name -> kind and shape of a policy's inputs or outputs."""
    if len(features) > _MOST_FEATURES:
        raise ManipError(f"{len(features)} features; expected at most {_MOST_FEATURES}")
    found: dict[str, tuple[str, tuple[int, ...]]] = {}
    for key, value in features.items():
        checks.text("name of a feature", key, checks.LONGEST_NAME)
        feature = checks.mapping(key, value)
        shape = checks.array(f"shape of {key}", feature.get("shape"), 4)
        sizes = tuple(checks.whole(f"a side of {key}", side, 1, _LONGEST_SIDE) for side in shape)
        found[key] = checks.text(f"type of {key}", feature.get("type"), checks.LONGEST_NAME), sizes
    return found


def check_interface(interface: Interface, spec: RobotTaskSpec) -> None:
    """Raise `MismatchError` naming both unless an environment of `spec` has every input and takes the action."""
    environment = f"{spec.robot}/{spec.task}"
    have = {STATE: len(spec.joint_names), ENVIRONMENT_STATE: len(spec.environment_state_names)}
    known = [*have, *spec.image_keys]
    if any(key not in known for key in interface.columns):
        raise MismatchError("inputs", "the policy", ", ".join(interface.columns), environment, ", ".join(known))
    for key, width in interface.numbers.items():
        if width != have[key]:
            raise MismatchError(f"width of {key}", "the policy", width, environment, have[key])
    if interface.robot not in ("", spec.robot):
        raise MismatchError("robot, whose hand moves,", "the policy", interface.robot, environment, spec.robot)
    if interface.action != have[STATE]:
        raise MismatchError("width of the action", "the policy", interface.action, environment, have[STATE])
    for camera, size in interface.pictures.items():
        if size != spec.image_size:
            raise MismatchError(f"size of the pictures of {camera}", "the policy", size, environment, spec.image_size)


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


def require_trust(settings: Mapping[str, Any], source: str, trust: bool, folder: Path | None = None) -> None:
    """Raise `ManipError` unless a policy loads nothing by name, or `trust` is given; says what would be loaded.

    settings: its options with `type`, as `config.json` has them. source: of them, for the message. folder: a
    checkpoint, whose processors are looked at as well; of these, steps by import path are refused in any case.
    """
    kind = settings["type"]
    wanted = _models(kind, settings)
    if folder is not None:
        wanted += [one for name in PROCESSORS for one in _other_steps(folder / name)]
    if wanted and not trust:
        raise ManipError(
            f"{source} is a policy of type {kind!r} that would load {'; '.join(wanted)}: this fetches files and may "
            "run code that comes with them; if you trust its source, add --trust=true"
        )


def _models(kind: str, settings: Mapping[str, Any]) -> list[str]:
    """The models that a policy's options name."""
    named = {option: settings[option] for option in _NAMES.get(kind, ()) if settings.get(option) is not None}
    if named:
        return [_list_options(f"models by name ({CONFIG})", named)]
    return [] if kind in PLAIN else [f"models that LeRobot's {kind!r} names itself"]


def _other_steps(path: Path) -> Iterator[str]:
    """The steps of a processor's file that are not LeRobot's default, or have options that those have not."""
    for step in processor_steps(path):
        name, options = step["registry_name"], step["config"]
        if name not in _STEPS:
            yield _list_options(f"the step {checks.shorten(name)} of {path.name}", options)
        elif extra := {key: options[key] for key in options if key not in _STEPS[name]}:
            yield _list_options(f"the step {name!r} of {path.name} with options of its own", extra)


def _list_options(what: str, options: Mapping[str, Any]) -> str:
    """`what` with the three options that say most, the names of models first."""
    first = sorted(options.items(), key=lambda item: not isinstance(item[1], str))[:3]
    text = ", ".join(f"{checks.shorten(key)[1:-1]}={checks.shorten(value)}" for key, value in first)
    return f"{what}: {text}" if text else what
