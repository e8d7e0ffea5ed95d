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
from lerobot.configs import NormalizationMode, PolicyFeature, PreTrainedConfig
from lerobot.configs.default import DatasetConfig, WandBConfig
from lerobot.configs.train import TrainPipelineConfig
from lerobot.optim import LRSchedulerConfig, OptimizerConfig
from lerobot.utils.feature_utils import dataset_to_policy_features

from manip_il.data.info import PICTURES
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, JOINT_TARGETS, STATE, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.learn.batches import Augment
from manip_il.learn.fit_config import JOINT_TARGET, MLP, NOT_OURS, OWN_SPACE, FitConfig, check_convertible
from manip_il.learn.limits import check_numbers
from manip_il.learn.mlp.configuration_mlp import MLPConfig
from manip_il.learn.pretrained import CONFIG, OBSERVATIONS, PLAIN, read_config, read_interface, require_trust

PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")
_OF_THE_MACHINE = ("device", "pretrained_path")  # where a policy runs and where its weights came from
_LACKING = {
    STATE: "every policy needs the measured joints",
    ENVIRONMENT_STATE: "choose the observation 'images', or record with `manip-il record`",
    IMAGES: "record with --cameras=front,wrist, add pictures (`manip-il data render`), or choose observation 'state'",
    ACTION: "there is nothing to learn",
}


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


def policy_config(settings: Mapping[str, Any], *, trust: bool = False) -> PreTrainedConfig:
    """Return the configuration of `type` (by default the mlp's), or of the checkpoint in `path`, with the rest changed.

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
    kind = settings.pop("type", MLP)
    cls, source = policy_class(kind), f"--policy.type={kind}"
    require_trust({**settings, "type": kind}, source, trust)
    return _policy(cls, settings, settings, source)


def _from_checkpoint(path: Path, settings: dict[str, Any], trust: bool) -> PreTrainedConfig:
    if "type" in settings:
        raise UsageError("give one of --policy.path=DIR and --policy.type=...: the type is in the checkpoint")
    saved = read_config(path)
    cls, source = policy_class(saved["type"]), f"--policy.path={path}"
    require_trust(saved | settings, source, trust)
    if saved["type"] in PLAIN:
        check_numbers(saved, str(path / CONFIG))
    # The weights are in the checkpoint; torchvision would download its own first.
    unused = ("type", "pretrained_backbone_weights", *NOT_OURS)
    kept = {key: value for key, value in saved.items() if key not in unused}
    if "pretrained_backbone_weights" in saved:
        kept["pretrained_backbone_weights"] = None
    config = _policy(cls, kept | settings, settings, source)
    config.pretrained_path = path
    return config


def _policy(
    cls: type[PreTrainedConfig], options: Mapping[str, Any], given: Mapping[str, Any], source: str
) -> PreTrainedConfig:
    """The configuration with no more `n_action_steps` than a plan has, unless the user gave that number."""
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    values, options = defaults | dict(options), dict(options)
    wanted = values.get("n_action_steps")
    plan = next((values[name] for name in ("chunk_size", "action_horizon", "horizon") if name in defaults), None)
    if "n_action_steps" not in given and isinstance(wanted, int) and isinstance(plan, int):
        if "horizon" in defaults:  # a plan that begins with the first observation
            plan -= max(0, values["n_obs_steps"] - 1) if isinstance(values["n_obs_steps"], int) else 0
        if 1 <= plan < wanted:
            options["n_action_steps"] = plan
    config = typing.cast(PreTrainedConfig, _decode(cls, options, source))
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
    if isinstance(value, Enum):
        return value.name
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {_printed(one)}" for key, one in value.items()) + "}"
    if isinstance(value, list | tuple):
        return "[" + ", ".join(map(_printed, value)) + "]"
    return "null" if value is None else str(value).lower() if isinstance(value, bool) else str(value)


def _decode(cls: type[Any], settings: Mapping[str, Any], source: str) -> Any:
    known = [field.name for field in dataclasses.fields(cls) if field.init and field.name not in NOT_OURS]
    for name in settings:
        if name not in known:
            raise UnknownName(f"option of {source}:", name, known)
    try:
        with _quiet():
            return draccus.decode(cls, dict(settings))
    except (DecodingError, ParsingError, ValueError, TypeError, NotImplementedError, ImportError) as error:
        reason = error if isinstance(error, DecodingError) else error.__cause__ or error
        raise UsageError(f"{source}: {' '.join(str(reason).split())}") from error


@contextmanager
def _quiet():
    """Drop LeRobot's warning of a device that it looks for before it knows which one the user wants."""
    logger = logging.getLogger("lerobot.configs.policies")
    level = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(level)


def set_features(config: PreTrainedConfig, meta: Any, observation: str) -> None:
    """Give a policy its inputs and outputs, from a dataset's features and the observation wanted.

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


def policy_features(
    features: Mapping[str, dict[str, Any]], observation: str
) -> tuple[dict[str, PolicyFeature], dict[str, PolicyFeature]]:
    """Return LeRobot's input and output features of a policy, from the `features` of `info.json`.

    observation: `state` is `observation.state` and `observation.environment_state`, `images` is `observation.state`
    and every camera, `both` all three. Pictures, (H, W, 3) in the table, are (3, H, W) for a policy. Raises
    `UnknownName` for another choice, `ManipError` for what the table lacks.
    """
    if observation not in OBSERVATIONS:
        raise UnknownName("observation", observation, OBSERVATIONS)
    cameras = [key for key, feature in features.items() if feature["dtype"] in PICTURES]
    wanted = [STATE]
    if observation != "images":
        wanted.append(ENVIRONMENT_STATE)
    if observation != "state":
        wanted += cameras or [IMAGES]
    for key in (*wanted, ACTION):
        if key not in features:
            what = "pictures" if key == IMAGES else key
            raise ManipError(f"observation {observation!r}: the dataset has no {what}; {_LACKING[key]}")
    typed = dataset_to_policy_features({key: features[key] for key in (*wanted, ACTION)})
    typed = {key: PolicyFeature(feature.type, tuple(feature.shape)) for key, feature in typed.items()}
    return {key: typed[key] for key in wanted}, {ACTION: typed[ACTION]}


class LeRobotFit:
    """The options of a fit as LeRobot's configurations: policy, optimiser, schedule, logger.

    action_meaning: of the data's numbers; where they are no joint targets, they are learnt as they are by default.
    observation: what the policy sees. action_space: in which it learns. augment: of pictures, None for none. Raises
    what `policy_config` raises, `UnknownName` or `UsageError` for an optimiser, a schedule or a logger that LeRobot
    does not know, `MismatchError` for a checkpoint to start from that has learnt in another action space.
    """

    def __init__(self, config: FitConfig, action_meaning: str = RobotTaskSpec.action_meaning):
        self.config = config
        self.policy = policy_config(config.policy, trust=config.trust)
        if config.init_from is not None and not config.is_mlp:
            self.policy.pretrained_path = config.init_from
        self.observation = config.observation or ("images" if self.policy.type == "cnn" else "state")
        self.action_space = _action_space(self.policy, config, action_meaning)
        self.augment = Augment() if config.augments else None
        self.wandb: WandBConfig = _decode(WandBConfig, config.wandb, "--wandb")
        self._optimizer = choice(OptimizerConfig, config.optimizer, "optimizer") if config.optimizer else None
        self._scheduler = choice(LRSchedulerConfig, config.scheduler, "scheduler") if config.scheduler else None

    def optimizer(self) -> OptimizerConfig:
        """Return the optimiser asked for, else the policy's preset, with the learning rate asked for."""
        optimizer = self._optimizer or self.policy.get_optimizer_preset()
        if (lr := self.config.peak_lr) is not None:
            optimizer.lr = lr
        return optimizer

    def scheduler(self) -> LRSchedulerConfig | None:
        """Return the schedule asked for, else the policy's preset; None is a constant rate, or the mlp's own loop."""
        return None if self.config.is_mlp else self._scheduler or self.policy.get_scheduler_preset()

    def pipeline(self, repo_id: str, root: str | None, output_dir: Path) -> TrainPipelineConfig:
        """Return what LeRobot writes as `train_config.json`, from which `lerobot-train --resume=true` goes on."""
        return TrainPipelineConfig(
            dataset=DatasetConfig(repo_id, root=root),
            policy=self.policy,
            output_dir=output_dir,
            job_name=f"manip_il_{self.policy.type}",
            seed=self.config.seed,
            num_workers=self.config.num_workers,
            batch_size=self.config.samples_per_step,
            steps=self.config.total_steps,
            env_eval_freq=0,
            log_freq=self.config.log_freq,
            save_freq=self.config.steps_per_checkpoint,
            optimizer=self.optimizer(),
            scheduler=self.scheduler(),
            wandb=self.wandb,
        )

    def resume_options(self) -> dict[str, Any]:
        """Return the options that a resumed fit must share with the one before, as JSON knows them."""
        policy, scheduler = draccus.encode(self.policy), self.scheduler()
        return {
            "policy": {name: value for name, value in policy.items() if name not in _OF_THE_MACHINE},
            "optimizer": draccus.encode(self.optimizer()),
            "scheduler": draccus.encode(scheduler) if scheduler else None,
            "augment": draccus.encode(self.augment) if self.augment else None,
            "steps": self.config.total_steps,
            "batch_size": self.config.samples_per_step,
            "seed": self.config.seed,
            "observation": self.observation,
            "action_space": self.action_space,
            "eval_split": self.config.eval_split,
            "lr": self.config.lr,
        }


def _action_space(policy: PreTrainedConfig, config: FitConfig, meaning: str) -> str:
    """The action space of a fit, also put into the configuration of a policy that has it there."""
    wanted, start = config.action_space, config.init_from or config.policy.get("path")
    if wanted is None and "action_space" not in config.policy and meaning not in JOINT_TARGETS:
        wanted = JOINT_TARGET
    known = start is not None and (Path(start) / CONFIG).is_file()  # else the weights are missing, too, which is said
    before = read_interface(Path(start)).space if start is not None and known else None
    if policy.type in OWN_SPACE:
        own = typing.cast(MLPConfig, policy)
        if wanted not in (None, own.action_space) and "action_space" in config.policy:
            raise UsageError(f"give one of --action_space={wanted} and --policy.action_space={own.action_space}")
        own.action_space = space = wanted or own.action_space
    else:
        space = wanted or before or JOINT_TARGET
    if before not in (None, space):
        raise MismatchError("action space", f"the checkpoint {start}", before, "this fit", space)
    check_convertible(policy.type, space)
    return space
