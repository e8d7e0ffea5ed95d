"""Checkpoints in LeRobot's layout, with what a policy was trained for beside the weights.

    OUTPUT/checkpoints/004000/pretrained_model/   config.json model.safetensors policy_*processor*.json|safetensors
                                                  manip_il.json; but for the mlp train_config.json README.md
                             /training_state/     optimizer_*.safetensors|json, training_step.json; but for the mlp
                                                  scheduler and random state
    OUTPUT/checkpoints/last -> 004000

A checkpoint is written under a temporary name and `last` is switched over in one rename, so that a kill leaves the one
before. All but the mlp's go on with
`lerobot-train --config_path=OUTPUT/checkpoints/last/pretrained_model/train_config.json --resume=true`, too.

What is written beside data and policies, for whom: `spec` (names, sizes and rate that a dataset, an environment and a
policy must share, a `RobotTaskSpec`); `fingerprint` (versions and hashes of the program and the scene that made
something, compared in warnings); `provenance` (how a dataset was recorded, rendered or merged, kept with it);
`CheckpointMeta` (the spec's names, the fingerprint and the options of the fit, in `manip_il.json`); `options` or
settings (what a user asked for, by name).
"""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Generator, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import MISSING, asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.atomic import umask, writing
from manip_il.data.schema import OWN_OBJECT, RobotTaskSpec
from manip_il.errors import FolderExistsError, ManipError, MismatchError

META_FILE = "manip_il.json"
PRETRAINED_MODEL = "pretrained_model"
TRAINING_STATE = "training_state"
_LAST = "last"
_LARGEST_META = 1024 * 1024  # [bytes]
_LARGEST_STEP = 10**12
_FASTEST, _MOST_NAMES, _LONGEST_WORDS, _LONGEST_SIDE = 10_000, 1_000, 1_000, 100_000
STEP_FILE = "training_step.json"
_MUST_AGREE = {
    "robot": "robot",
    "fps": "control rate [1/s]",
    "joint_names": "joint names",
    "object": "object",
    "environment_state_names": "environment state",
    "action_meaning": "meaning of the action",
}


@dataclass(frozen=True)
class CheckpointMeta:
    """Robot, task and data that a policy was trained for, and the options of its fit; `manip_il.json`.

    observation: one of `learn.pretrained.OBSERVATIONS`. cameras, image_size: of the pictures that it was
    trained on, where it sees any; look: their light, as arguments of `sim.look.Look`, None where that is not known.
    datasets: folder, frames and weight of each, as `Sources.to_json` has them.
    action_space: in which it learnt, None in a checkpoint from before there was a choice.
    """

    robot: str
    task: str
    fps: int
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
    object: str = ""  # see `RobotTaskSpec`

    def __post_init__(self) -> None:
        for name in ("robot", "task"):
            checks.name(name, getattr(self, name))
        checks.whole("fps", self.fps, 1, _FASTEST)
        checks.text("action_meaning", self.action_meaning, _LONGEST_WORDS)
        checks.text("object", self.object, _LONGEST_WORDS)
        checks.text("observation", self.observation, checks.LONGEST_NAME)
        if self.action_space is not None:
            checks.text("action_space", self.action_space, checks.LONGEST_NAME)
        for name in ("joint_names", "environment_state_names", "cameras"):
            for word in checks.array(name, getattr(self, name), _MOST_NAMES):
                checks.text(f"one of {name}", word, _LONGEST_WORDS)
        if len(size := checks.array("image_size", self.image_size, 2)) != 2:
            raise ManipError(f"image_size is {size}; expected height and width")
        for side in size:
            checks.whole("a side of image_size", side, 0, _LONGEST_SIDE)
        for one in checks.array("datasets", self.datasets, _MOST_NAMES):
            checks.mapping("one of datasets", one)
        for name in ("fingerprint", "options") if self.look is None else ("fingerprint", "options", "look"):
            if len(checks.mapping(name, getattr(self, name))) > _MOST_NAMES:
                raise ManipError(f"{name} has {len(getattr(self, name))} entries; expected at most {_MOST_NAMES}")

    @classmethod
    def of(
        cls,
        spec: RobotTaskSpec,
        fingerprint: Mapping[str, Any] | None = None,
        options: Mapping[str, Any] | None = None,
        observation: str = "state",
        look: Mapping[str, Any] | None = None,
        datasets: Sequence[Mapping[str, Any]] = (),
        action_space: str | None = None,
    ) -> CheckpointMeta:
        """Return the meta of a policy trained on data of `spec`.

        look: `recorded_look` of the dataset. datasets: `Sources.to_json`.
        """
        meta = cls(
            **{name: getattr(spec, name) for name in ("task", *_MUST_AGREE)},
            fingerprint=dict(fingerprint or {}),
            options=dict(options or {}),
            observation=observation,
            datasets=[dict(one) for one in datasets],
            action_space=action_space,
        )
        if observation == "state":
            return meta
        return replace(
            meta, cameras=spec.cameras, image_size=spec.image_size, look=None if look is None else dict(look)
        )


def read_meta(pretrained_model: Path) -> CheckpointMeta | None:
    """Return the checkpoint's meta, or None where another tool (lerobot-train) wrote the checkpoint.

    Raises `ManipError` for a file that is not ours or not whole.
    """
    path = Path(pretrained_model) / META_FILE
    if not path.is_file():
        return None
    try:
        values = checks.read_json(path, "what a policy was trained for", _LARGEST_META)
        for name in ("joint_names", "environment_state_names", "cameras", "image_size"):
            if name in values:  # a checkpoint from before there were pictures has no cameras
                values[name] = tuple(checks.array(name, values[name], _MOST_NAMES))
        known = {one.name: one for one in fields(CheckpointMeta)}
        for name in values:
            if name not in known:
                raise ManipError(f"unexpected {checks.shorten(name)}")
        for name, one in known.items():
            if name not in values and one.default is one.default_factory is MISSING:
                raise ManipError(f"no {name}")
        return CheckpointMeta(**values)
    except ManipError as error:
        raise ManipError(f"{path} cannot be read ({error}); train again, or restore the file") from error


def check_fits(meta: CheckpointMeta, spec: RobotTaskSpec) -> None:
    """Raise `MismatchError` naming both sides unless the policy's numbers mean what `spec`'s do."""
    for name, what in _MUST_AGREE.items():
        if name == "environment_state_names" and meta.observation == "images":
            continue  # it does not look at it
        ours, theirs = getattr(meta, name), getattr(spec, name)
        if name == "object":
            ours, theirs = ours or OWN_OBJECT, theirs or OWN_OBJECT
        if name == "environment_state_names" and ours != theirs and meta.task != spec.task:
            raise MismatchError("task", "the policy", meta.task, "the environment", spec.task)
        if ours != theirs:
            raise MismatchError(what, "the policy", ours, f"{spec.robot}/{spec.task}", theirs)


def recorded_look(provenance: Mapping[str, Any], fingerprint: Mapping[str, Any]) -> dict[str, Any] | None:
    """Return the light in which a dataset's pictures were made, as arguments of `sim.look.Look`; {} is the default.

    None where that is not known: another program's dataset, or one without pictures.
    """
    if "cameras_sha256" not in fingerprint:
        return None
    rendered = provenance.get("rendered", {}).get("cameras", {})  # `record` has the default light alone
    return dict(rendered.get("look", {}))


def last_checkpoint(output_dir: Path, *, resume: bool) -> Path | None:
    """Return the folder `checkpoints/last` to go on from, or None where there is none.

    Raises `FolderExistsError` where there is one, unless `resume`.
    """
    last = output_dir / "checkpoints" / _LAST
    if not (last / PRETRAINED_MODEL).is_dir():
        return None
    if not resume:
        raise FolderExistsError(output_dir)
    return last


def read_step(checkpoint: Path) -> dict[str, Any]:
    """Return the step and the resume key of a checkpoint folder. Raises `ManipError` where it has none."""
    path = checkpoint / TRAINING_STATE / STEP_FILE
    if not path.is_file():
        raise ManipError(f"no {path}: this checkpoint cannot be resumed; use it as init_from instead")
    values = checks.read_json(path, "the step of a run", _LARGEST_META)
    checks.whole(f"{path}: step", values.get("step"), 0, _LARGEST_STEP)
    return values


def check_same_run(checkpoint: Path, digest: str, options: Mapping[str, Any]) -> None:
    """Raise `MismatchError` unless the checkpoint's run learnt from the same data with the same options."""
    saved = read_step(checkpoint)
    if saved.get("data") != digest:
        raise MismatchError("training data", f"checkpoint {checkpoint}", saved.get("data"), "this run", digest)
    before = checks.mapping(f"{checkpoint}: options", saved.get("options", {}))
    for name, ours in options.items():
        if before.get(name) != ours:
            what = f"training option {name}"
            raise MismatchError(what, f"checkpoint {checkpoint}", before.get(name), "this run", ours)


@contextmanager
def readable_state(checkpoint: Path) -> Iterator[None]:
    """Turn what LeRobot, torch and safetensors raise for files that are not whole into `ManipError`."""
    try:
        yield
    except ManipError:
        raise
    except Exception as error:  # of every kind: files of tensors and JSON, read by others' code
        line = checks.shorten(" ".join(str(error).split()))
        raise ManipError(
            f"{checkpoint} cannot be resumed ({type(error).__name__}: {line}); start again with --overwrite=true"
        ) from error


@contextmanager
def unpublished(final: Path) -> Generator[Path]:
    """Give an empty folder to write a checkpoint into; on leaving, it gets its name and is `last`.

    An exception removes it. Raises `WriteError` where the disk is full or read-only.
    """
    temporary = final.parent / f".{final.name}.tmp"
    try:
        with writing(final):
            final.parent.mkdir(parents=True, exist_ok=True)
            for stale in (temporary, final):  # of a run that was killed before it could switch `last` over
                shutil.rmtree(stale, ignore_errors=True)
            temporary.mkdir()
            yield temporary
            publish(temporary, final)
    finally:
        shutil.rmtree(temporary, ignore_errors=True)


def publish(temporary: Path, final: Path) -> None:
    """Give a checkpoint that is whole its name, and make it `last`."""
    for path in temporary.rglob("*"):
        if path.is_file():  # safetensors hides its files from other users, a container's among them
            path.chmod(0o666 & ~umask())
    temporary.rename(final)
    link = final.parent / ".last.tmp"
    link.unlink(missing_ok=True)
    link.symlink_to(final.name)
    os.replace(link, final.parent / _LAST)  # in one rename


def write_own_files(checkpoint: Path, meta: CheckpointMeta, step: Mapping[str, Any]) -> None:
    """Write what LeRobot's checkpoints have not: the meta, and the step with the resume key."""
    words = {name: value for name, value in asdict(meta).items() if value or name != "object"}
    for path, values in ((f"{PRETRAINED_MODEL}/{META_FILE}", words), (f"{TRAINING_STATE}/{STEP_FILE}", step)):
        (checkpoint / path).write_text(json.dumps(values, indent=2) + "\n")
