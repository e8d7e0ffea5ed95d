"""LeRobot's configurations (policy, optimiser, schedule, ...) from the options that a user gave, by LeRobot's names."""

from __future__ import annotations

import copy
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

from manip_il.data.schema import ACTION, JOINT_TARGETS, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.learn.batches import Augment
from manip_il.learn.checkpoint import Checkpoint, require_trust
from manip_il.learn.fit_config import FitConfig, check_convertible
from manip_il.learn.names import JOINT_TARGET, OWN_SPACE

PLUGINS = ("manip_il.learn.mlp", "manip_il.learn.cnn")
# Where a policy's configuration is kept with what was meant for one machine or one command.
NOT_OURS = ("push_to_hub", "repo_id", "private", "pretrained_path", "pretrained_revision", "use_peft")
_OF_THE_MACHINE = ("device", "pretrained_path")  # where a policy runs and where its weights came from


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


def policy_config(fit: FitConfig) -> PreTrainedConfig:
    """Return the configuration of the policy of a fit: new, or that of the checkpoint to start from, changed.

    The device is the graphics card if there is one. As many actions are taken of a plan as it has, if LeRobot's
    default is more. Raises `UnknownName` for a type or an option that is not there, `UsageError` for a value that
    LeRobot refuses, `ManipError` if models are named that would have to be trusted.
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
    plan = _shorter_plan(cls, options, given)
    config = typing.cast(PreTrainedConfig, decode(cls, options | plan, source))
    config.push_to_hub = False  # LeRobot's default is to upload; here nothing leaves the machine unasked
    start = fit.init_from or (fit.start.path if fit.start else None)
    config.pretrained_path = None if start is None else Path(start)
    return config


def _shorter_plan(cls: type[PreTrainedConfig], options: Mapping[str, Any], given: Mapping[str, Any]) -> dict[str, int]:
    """The number of `n_action_steps` that a plan has, if it is fewer than the default and the user gave none."""
    defaults = {field.name: field.default for field in dataclasses.fields(cls)}
    values = defaults | dict(options)
    wanted = values.get("n_action_steps")
    plan = next((values[name] for name in ("chunk_size", "action_horizon", "horizon") if name in defaults), None)
    if "n_action_steps" in given or not isinstance(wanted, int) or not isinstance(plan, int):
        return {}
    if "horizon" in defaults:  # a plan that begins with the first observation
        plan -= max(0, values["n_obs_steps"] - 1) if isinstance(values["n_obs_steps"], int) else 0
    return {"n_action_steps": plan} if 1 <= plan < wanted else {}


def choice(base: type[Any], settings: Mapping[str, Any], group: str) -> Any:
    """Return one of the configurations registered under `base`, by `settings["type"]`: an optimiser, a schedule."""
    settings = dict(settings)
    known = sorted(base.get_known_choices())
    kind = settings.pop("type", None)
    if kind not in known:
        raise UnknownName(f"--{group}.type", str(kind), known)
    return decode(base.get_choice_class(kind), settings, f"--{group}.type={kind}")


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


class LeRobotFit:
    """The options of a fit as LeRobot's configurations: policy, optimiser, schedule, logger.

    action_meaning: of the data's numbers; if they are no joint targets, they are learnt as they are by default.
    action_space: in which the policy learns. augment: of pictures, None for none. Raises what `policy_config` raises,
    `UnknownName` or `UsageError` for an optimiser, a schedule or a logger that LeRobot does not know, `MismatchError`
    for a checkpoint to start from that has learnt in another action space.
    """

    def __init__(self, config: FitConfig, action_meaning: str = RobotTaskSpec.action_meaning):
        self.config, self.observation = config, config.observes
        self.policy = policy_config(config)
        self.action_space = _action_space(self.policy, config, action_meaning)
        self.augment = Augment() if config.augments else None
        self.wandb: WandBConfig = decode(WandBConfig, config.wandb, "--wandb")
        self._optimizer = choice(OptimizerConfig, config.optimizer, "optimizer") if config.optimizer else None
        self._scheduler = choice(LRSchedulerConfig, config.scheduler, "scheduler") if config.scheduler else None

    def set_features(self, features: Mapping[str, dict[str, Any]], inputs: Sequence[str]) -> None:
        """Give the policy its inputs and outputs, from a dataset's features.

        LeRobot's policies for states leave `observation.environment_state` in its raw units unless told otherwise: here
        it is normalised as the joint state is. Raises `ManipError` for what the policy refuses.
        """
        policy = self.policy
        policy.input_features, policy.output_features = policy_features(features, inputs)
        modes: dict[str, NormalizationMode] = getattr(policy, "normalization_mapping", {})
        if "STATE" in modes:
            modes.setdefault("ENV", modes["STATE"])
        try:
            policy.validate_features()
        except ValueError as error:
            raise ManipError(f"--policy.type={policy.type} with --observation={self.observation}: {error}") from error

    def optimizer(self) -> OptimizerConfig:
        """Return the optimiser asked for, else the policy's preset, with the learning rate asked for."""
        optimizer = self._optimizer or self.policy.get_optimizer_preset()
        if self.config.lr is not None:
            optimizer.lr = self.config.lr
        return optimizer

    def scheduler(self) -> LRSchedulerConfig | None:
        """Return the schedule asked for, else the policy's preset; None is a constant rate."""
        return self._scheduler or self.policy.get_scheduler_preset()

    def pipeline(self, repo_id: str, root: Path, output_dir: Path) -> TrainPipelineConfig:
        """Return what LeRobot writes as `train_config.json`, from which `lerobot-train --resume=true` goes on."""
        return TrainPipelineConfig(
            dataset=DatasetConfig(repo_id, root=str(root)),
            policy=self.policy,
            output_dir=output_dir,
            job_name=f"manip_il_{self.policy.type}",
            seed=self.config.seed,
            batch_size=self.config.samples_per_step,
            steps=self.config.total_steps,
            env_eval_freq=0,
            log_freq=self.config.log_freq,
            save_freq=self.config.steps_per_checkpoint,
            optimizer=self.optimizer(),
            scheduler=self.scheduler(),
            wandb=self.wandb,
        )

    def to_json(self) -> dict[str, Any]:
        """Return the options by which a checkpoint names its fit, without those of one machine."""
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


def without_places(pipeline: TrainPipelineConfig) -> TrainPipelineConfig:
    """Return the pipeline without absolute paths: from the current folder on, or else the folder's name alone."""

    def portable(path: Path) -> Path:
        if not path.is_absolute():
            return path
        return path.relative_to(Path.cwd()) if path.is_relative_to(Path.cwd()) else Path(path.name)

    saved = copy.copy(pipeline)
    saved.dataset = dataclasses.replace(pipeline.dataset, root=str(portable(Path(str(pipeline.dataset.root)))))
    saved.output_dir = portable(Path(str(pipeline.output_dir)))
    return saved


def _action_space(policy: PreTrainedConfig, config: FitConfig, meaning: str) -> str:
    """The action space of a fit, also put into the configuration of a policy that has it there."""
    wanted = config.action_space
    if wanted is None and "action_space" not in config.policy and meaning not in JOINT_TARGETS:
        wanted = JOINT_TARGET
    start = config.start or (Checkpoint.open(config.init_from) if config.init_from else None)
    if policy.type in OWN_SPACE:
        own: Any = policy
        if wanted not in (None, own.action_space) and "action_space" in config.policy:
            raise UsageError(f"give one of --action_space={wanted} and --policy.action_space={own.action_space}")
        own.action_space = space = wanted or own.action_space
    else:
        space = wanted or (start.space if start else JOINT_TARGET)
    if start is not None and start.space != space:
        raise MismatchError("action space", f"the checkpoint {start.path}", start.space, "this fit", space)
    check_convertible(policy.type, space)
    return space
