"""A `pretrained_model` folder, possibly downloaded: it is checked before anything in it is loaded.

LeRobot's language and vision policies load tokenizers, encoders and whole models that the
checkpoint names, some with `trust_remote_code`, which runs Python from the named repository.
Policies that are built only from their own configuration and weights are listed in `PLAIN`, their
processors' steps in `_STEPS`; all others need `--trust=true`.

Find the policy in a `pretrained_model` folder, a checkpoint or a run.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from types import MappingProxyType
from typing import Any

from safetensors.numpy import load_file

from manip_il import checks
from manip_il.data.fingerprint import policy_sha256
from manip_il.data.schema import (
    ACTION,
    ENVIRONMENT_STATE,
    IMAGES,
    MUST_AGREE,
    STATE,
    check_same_spec,
)
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.learn.names import ACTION_SPACES, JOINT_TARGET, OWN_SPACE, PLAIN
from manip_il.mdp import F64
from manip_il.sim.config import CameraConfig, Look
from manip_il.worlds.contract import EnvironmentSpec

CONFIG = "config.json"
WEIGHTS = "model.safetensors"
META_FILE = "manip_il.json"
# steps that convert actions
MEASURED, DECODER = "manip_il_measured_joints", "manip_il_joint_targets"
JOINTS_ALONE = "manip_il_joints_alone"  # step of a policy that observes nothing else
_STEPS = (  # registry names of LeRobot's default steps, and ours: they load nothing
    *("rename_observations_processor", "to_batch_processor", "device_processor"),
    *("normalizer_processor", "unnormalizer_processor", MEASURED, DECODER, JOINTS_ALONE),
)
PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_STATISTICS = "*_normalizer_processor.safetensors"  # of the training data
MOST_VALUES = 10_000  # in one numeric input of a network, or in its action
_IK_ROBOT = "robot of the inverse kinematics"
# prefix of dummy cameras that LeRobot's language policies fill in themselves
_PLACEHOLDER = IMAGES + "empty_camera_"


@dataclass(frozen=True)
class Origin:
    """Content of `manip_il.json`: a policy's robot and task, its training data, and the options of
    its fit.

    Attributes:
        robot: The robot's name.
        task: The task's name.
        fps: The control rate [Hz], as in `EnvironmentSpec`.
        joint_names: Names of the numbers of the joint state and the action.
        environment_state_names: Names of the numbers of the environment state.
        action_meaning: As in `EnvironmentSpec`.
        fingerprint: The fingerprint of the training data.
        options: The options of the fit.
        observation: One of `OBSERVATIONS`.
        cameras: The cameras of the training pictures, if any.
        image_size: The height and width of the training pictures [pixels], if any.
        look: The lighting of the training pictures, as arguments of `sim.look.Look`; None if
            unknown.
        datasets: Name, frames and weight of each dataset.
        action_space: The space that the policy learnt in; None for a checkpoint older than this
            field.
        object: As in `EnvironmentSpec`.
    """

    robot: str
    task: str
    fps: float  # as in `EnvironmentSpec`
    joint_names: tuple[str, ...]
    environment_state_names: tuple[str, ...]
    action_meaning: str
    fingerprint: dict[str, Any] = field(default_factory=dict)
    options: dict[str, Any] = field(default_factory=dict)
    observation: str = "state"
    cameras: tuple[str, ...] = ()
    image_size: tuple[int, int] = (0, 0)  # height, width [pixels]
    look: dict[str, Any] | None = None
    datasets: list[dict[str, Any]] = field(default_factory=list)
    action_space: str | None = None
    object: str = ""  # see `EnvironmentSpec`, also for the next one
    state_names: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        checks.name("robot", self.robot)
        checks.task_name(self.task)
        checks.object_name(self.object)
        names = ("joint_names", "state_names", "environment_state_names")
        for name in (*names, "cameras", "image_size"):
            object.__setattr__(self, name, tuple(getattr(self, name)))

    @classmethod
    def of(
        cls,
        spec: EnvironmentSpec,
        fingerprint: Mapping[str, Any] = MappingProxyType({}),
        options: Mapping[str, Any] = MappingProxyType({}),
        **more: Any,
    ) -> Origin:
        """Return the origin of a policy trained on data of `spec`.

        Args:
            spec: The specification of the training data.
            fingerprint: The fingerprint of the training data.
            options: The options of the fit.
            more: Other fields of `Origin`. Without pictures among the observations, cameras and
                picture size are left out.
        """
        pictured = more.get("observation", "state") != "state"
        names = ("task", *MUST_AGREE, *(("cameras", "image_size") if pictured else ()))
        same = {name: getattr(spec, name) for name in names}
        return cls(**same, fingerprint=dict(fingerprint), options=dict(options), **more)

    def write(self, folder: Path) -> None:
        """Write `manip_il.json` into a `pretrained_model` folder."""
        (folder / META_FILE).write_text(json.dumps(asdict(self), indent=2) + "\n")

    def check_fits(self, spec: EnvironmentSpec) -> None:
        """Raise `MismatchError` naming both sides unless states and actions mean the same as in
        `spec`.
        """
        names, seen = spec.environment_state_names, self.observation != "images"
        other_task = seen and self.environment_state_names != names and self.task != spec.task
        ours = self if seen and not other_task else replace(self, environment_state_names=names)
        check_same_spec(
            "the policy", ours, f"{spec.robot}/{spec.task}", spec, ("task",) if other_task else ()
        )


def read_origin(path: Path) -> Origin | None:
    """Return the origin in a `pretrained_model` folder, or None if another tool (lerobot-train)
    wrote it.

    Raises:
        ManipError: The file is incomplete or not ours.
    """
    file = Path(path) / META_FILE
    if not file.is_file():
        return None
    with in_one_line(f"{file} cannot be read"):
        return Origin(**checks.read_json(file, "what a policy was trained for"))


@dataclass(frozen=True)
class Checkpoint:
    """A policy on disk.

    Attributes:
        path: The policy's `pretrained_model` folder.
        config: The content of its `config.json`.
        numbers: Size of each numeric input by column.
        pictures: Height and width of the pictures by camera [pixels].
        action: Size of the action.
        space: The action space that the policy learnt in.
        robot: The arm, for `ee_delta` only.
        grippers: See `Conversion`.
        origin: The content of `manip_il.json`; None if another program wrote the folder.
        processors: The steps of each processor's file, with `registry_name` and `config`.
    """

    path: Path
    config: Mapping[str, Any]
    numbers: Mapping[str, int]
    pictures: Mapping[str, tuple[int, int]]
    action: int
    space: str
    robot: str
    grippers: tuple[int, ...]
    origin: Origin | None
    processors: Mapping[str, Sequence[Mapping[str, Any]]]

    def __repr__(self) -> str:
        trained_for = f"{self.origin.robot} {self.origin.task}" if self.origin else "unknown"
        return f"Checkpoint({self.kind}, {trained_for}, {str(self.path)!r})"

    @classmethod
    def of(cls, policy: Checkpoint | Path | str) -> Checkpoint:
        """Return a checkpoint as it is, or open the one that `find_policy` finds in a path.

        Raises what `find_policy` and `open` raise.
        """
        if isinstance(policy, Checkpoint):
            return policy
        return cls.open(find_policy(Path(policy).expanduser()))

    @classmethod
    def open(cls, path: Path) -> Checkpoint:
        """Read and check the files of a folder, except its weights.

        Raises:
            ManipError: The folder is incomplete, or gives a processor's step by an import path.
        """
        path = Path(path)
        config, origin = read_config(path), read_origin(path)
        processors = {
            name: processor_steps(path / name) for name in PROCESSORS if (path / name).is_file()
        }
        with in_one_line(f"{path / CONFIG} has features that cannot be read"):
            inputs = _features(config["input_features"])
            outputs = _features(config["output_features"])
            space, robot, grippers = _space(config, processors.get(PROCESSORS[1], []))
            return cls(
                path,
                config,
                numbers={
                    key: _size(key, shape)
                    for key, (kind, shape) in inputs.items()
                    # not the environment state of `JointsAloneStep`
                    if kind in ("STATE", "ENV") and all(shape)
                },
                pictures={
                    key.removeprefix(IMAGES): (shape[1], shape[2])
                    for key, (kind, shape) in inputs.items()
                    if kind == "VISUAL" and not key.startswith(_PLACEHOLDER)
                },
                action=_size(ACTION, outputs[ACTION][1]),
                space=space,
                robot=robot,
                grippers=grippers,
                origin=origin,
                processors=processors,
            )

    @cached_property
    def sha256(self) -> str:
        """The hash of everything that decides how the policy acts, see `policy_sha256`."""
        return policy_sha256(self.path)

    @cached_property
    def state_range(self) -> tuple[F64, F64]:
        """The least and the greatest joint state in the training data, (n,) each.

        Raises `ManipError` if the checkpoint has no statistics of it.
        """
        with in_one_line(f"{self.path} has no statistics of {STATE}"):
            [path] = self.path.glob(_STATISTICS)
            with checks.native_path(path, "statistics") as opened:
                found = load_file(opened)
            low, high = (found[f"{STATE}.{end}"].astype(float) for end in ("min", "max"))
            return low, high

    @property
    def kind(self) -> str:
        """LeRobot's name for the policy."""
        return self.config["type"]

    @property
    def options(self) -> dict[str, Any]:
        """The policy's options.

        Weights that torchvision would download are left out: the checkpoint has them.
        """
        options = {name: value for name, value in self.config.items() if name != "type"}
        return options | dict.fromkeys({"pretrained_backbone_weights"} & options.keys())

    @property
    def observation(self) -> str:
        """The member of `OBSERVATIONS` that the policy takes."""
        if not self.pictures:
            return "state"
        return "both" if ENVIRONMENT_STATE in self.numbers else "images"

    @property
    def cameras(self) -> CameraConfig | None:
        """Cameras, picture size and lighting as in training; None if the policy takes no pictures.

        The lighting is the default if the checkpoint has none.

        Raises:
            UsageError: Environments do not have the cameras, or the size is invalid.
        """
        if not self.pictures:
            return None
        known = self.origin is not None and set(self.origin.cameras) == set(self.pictures)
        names = self.origin.cameras if self.origin and known else tuple(self.pictures)
        look = self.origin.look if self.origin else None
        return CameraConfig(names, *next(iter(self.pictures.values())), Look(**(look or {})))

    def check_fits(self, spec: EnvironmentSpec) -> None:
        """Raise `MismatchError` naming both sides unless environments of `spec` have the
        policy's inputs and action.
        """
        if self.origin is not None:
            self.origin.check_fits(spec)
        environment, joints = f"{spec.robot}/{spec.task}", len(spec.joint_names)
        has: dict[str, Any] = {
            _IK_ROBOT: spec.robot,
            STATE: len(spec.observed_names),
            ACTION: joints,
            ENVIRONMENT_STATE: len(spec.environment_state_names),
            **dict.fromkeys(spec.image_keys, spec.image_size),
        }
        needs: dict[str, Any] = {
            **self.numbers,
            ACTION: self.action,
            **{IMAGES + camera: size for camera, size in self.pictures.items()},
            **({_IK_ROBOT: self.robot} if self.robot else {}),
        }
        for what, needed in needs.items():
            if has.get(what) != needed:
                raise MismatchError(what, "the policy", needed, environment, has.get(what))

    def require_trust(self, trust: bool) -> None:
        """Raise `ManipError` if the policy or its processors load models by name, unless `trust`
        is given.
        """
        steps = [step for steps in self.processors.values() for step in steps]
        require_trust(self.config, str(self.path), trust, steps)


def _size(key: str, shape: Sequence[int]) -> int:
    return checks.whole(f"the number of values of {key}", math.prod(shape), 0, MOST_VALUES)


def _features(features: Mapping[str, Any]) -> dict[str, tuple[str, tuple[int, ...]]]:
    """Return name -> kind and shape of a policy's inputs or outputs."""
    return {
        key: (str(value["type"]), tuple(map(int, value["shape"])))
        for key, value in features.items()
    }


def _space(
    config: Mapping[str, Any], steps: Sequence[Mapping[str, Any]]
) -> tuple[str, str, tuple[int, ...]]:
    """Return action space, robot and grippers: from the configuration of mlp and cnn, or the
    postprocessor's step.

    Where no grippers are named, only the last number counts as one.
    """
    decoder: Mapping[str, Any] = next(
        (step["config"] for step in steps if step["registry_name"] == DECODER), {}
    )
    given = config if config["type"] in OWN_SPACE else {"action_space": JOINT_TARGET, **decoder}
    space = given["action_space"]
    if space not in ACTION_SPACES:
        raise UnknownName("action space", checks.shorten(space), ACTION_SPACES)
    return space, str(decoder.get("robot", "")), tuple(given.get("grippers", (-1,)))


@contextmanager
def in_one_line(what: str) -> Iterator[None]:
    """Turn every error that a library raises on a malformed file into a one-line `ManipError`,
    `what: ...`.
    """
    try:
        yield
    except ManipError:
        raise
    except Exception as error:
        raise ManipError(f"{what}: {type(error).__name__}: {checks.one_line(error)}") from error


def require_trust(
    settings: Mapping[str, Any], source: str, trust: bool, steps: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Raise `ManipError` if a policy loads models or files by name, unless `trust` is given.

    Args:
        settings: The policy's options with `type`, as in `config.json`.
        source: Where the options come from, for the message.
        trust: Whether the policy's source is trusted.
        steps: The processors' steps, each with `registry_name` and `config`.

    Raises:
        ManipError: The policy is not trusted; the message lists the names.
    """
    kind, named = settings["type"], list[Any]()
    if kind not in PLAIN or settings.get("vision_encoder_name"):
        named += [value for name, value in settings.items() if "name" in name or "path" in name]
    for step in steps:
        if step["registry_name"] not in _STEPS:
            named += [step["registry_name"], *step["config"].values()]
    texts = sorted({value for value in named if isinstance(value, str)})
    if (kind not in PLAIN or texts) and not trust:
        raise ManipError(
            f"{source} is a policy of type {kind!r}, whose configuration names what to load"
            f" ({checks.shorten(texts)}): this downloads files and may run code in them; if you"
            " trust its source, add --trust=true"
        )


def read_config(path: Path) -> dict[str, Any]:
    """Return the `config.json` of a folder.

    Raises:
        ManipError: The folder is incomplete.
    """
    config = checks.read_json(path / CONFIG, "a LeRobot policy's config.json")
    if not (path / WEIGHTS).is_file():
        raise ManipError(f"no {WEIGHTS} in {path}: the weights are missing")
    if not isinstance(config.get("type"), str):
        raise ManipError(
            f"{path / CONFIG} is not the configuration of a LeRobot policy: it has no type"
        )
    return config


def processor_steps(path: Path) -> list[dict[str, Any]]:
    """Return the steps in a processor's file, each with `registry_name` and `config`.

    Raises:
        ManipError: The file cannot be read, or gives a step by an import path: LeRobot would import
            and call whatever a downloaded file names.
    """
    values = checks.read_json(path, "a processor of LeRobot's")
    with in_one_line(f"{path} cannot be read"):
        if odd := next((step for step in values["steps"] if "registry_name" not in step), None):
            name = checks.shorten(odd.get("class"))
            raise ManipError(f"{path} asks to run {name}; only registered steps are loaded")
        return [
            {
                "registry_name": str(step["registry_name"]),
                "config": checks.mapping("config", step.get("config", {})),
            }
            for step in values["steps"]
        ]


_PLACES = (
    *(".", "pretrained_model", "best/pretrained_model", "checkpoints/last/pretrained_model"),
    *("checkpoints/*/pretrained_model", "round_*/policy/checkpoints/*/pretrained_model"),
)


def find_policy(path: Path) -> Path:
    """Return `path` if it is a `pretrained_model` folder, else the best or newest one in this
    checkpoint or run.

    Raises:
        UsageError: There is no policy.
    """
    for place in _PLACES:
        if found := sorted(path.glob(f"{place}/{CONFIG}")):
            return found[-1].parent
    raise UsageError(
        f"no policy in {path}; expected LeRobot's pretrained_model folder, or a run that holds"
        " one; if it is on the Hub, get it by manip-il pull hf://USER/NAME FOLDER and give that"
        " FOLDER"
    )
