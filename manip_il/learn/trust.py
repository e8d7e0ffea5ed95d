"""What a `pretrained_model` folder may hold and may load: it is data from anywhere.

LeRobot's language and vision policies load tokenizers, encoders and whole models that the checkpoint names, some with
`trust_remote_code`, which runs Python from the named repository. Policies that are built from their own configuration
and weights alone are listed in `PLAIN`, the steps of their processors in `_STEPS`; all others need `--trust=true`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError
from manip_il.learn.names import PLAIN

CONFIG, WEIGHTS = "config.json", "model.safetensors"
MEASURED, DECODER = "manip_il_measured_joints", "manip_il_joint_targets"  # steps that carry an action space
LARGEST_JSON = 16 * 1024 * 1024  # [bytes]
_STEPS = (  # of LeRobot's default processors, and ours: they load nothing
    *("rename_observations_processor", "to_batch_processor", "device_processor"),
    *("normalizer_processor", "unnormalizer_processor", MEASURED, DECODER),
)
_PICKLES = (".bin", ".pt", ".pth", ".pkl", ".pickle", ".ckpt")


@contextmanager
def in_one_line(what: str) -> Iterator[None]:
    """Turn errors of every kind, which others' code raises for files from anywhere, into `ManipError`: `what: ...`."""
    try:
        yield
    except ManipError:
        raise
    except Exception as error:
        raise ManipError(f"{what}: {type(error).__name__}: {checks.one_line(error)}") from error


def require_trust(
    settings: Mapping[str, Any], source: str, trust: bool, steps: Sequence[Mapping[str, Any]] = ()
) -> None:
    """Raise `ManipError` unless a policy loads nothing by name, or `trust` is given; names what may be loaded.

    settings: its options with `type`, as `config.json` has them. source: of them, for the message. steps: of its
    processors.
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
            f"{source} is a policy of type {kind!r} that would load what it names ({checks.shorten(texts)}): this "
            "fetches files and may run code that comes with them; if you trust its source, add --trust=true"
        )


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
        raise ManipError(f"no {WEIGHTS} in {path}: the weights are missing")
    config = checks.read_json(path / CONFIG, "a LeRobot policy's config.json", LARGEST_JSON)
    if not isinstance(config.get("type"), str):
        raise ManipError(f"{path / CONFIG} is not a LeRobot policy's: it names no type")
    return config


def processor_steps(path: Path) -> list[dict[str, Any]]:
    """Return the steps that a processor's file names.

    Refuses a step by import path, as LeRobot would import and call whatever a downloaded file names, and a state
    outside of the folder.
    """
    values = checks.read_json(path, "a processor of LeRobot's", LARGEST_JSON)
    try:
        return [_step(path, step) for step in values["steps"]]
    except (ManipError, KeyError, TypeError, AttributeError) as error:
        raise ManipError(f"{path} cannot be read: {checks.one_line(error)}") from error


def _step(path: Path, step: dict[str, Any]) -> dict[str, Any]:
    if "registry_name" not in step:
        raise ManipError(f"it asks to run {checks.shorten(step.get('class'))}; only registered steps are loaded")
    known = {"registry_name": str(step["registry_name"]), "config": checks.mapping("config", step.get("config", {}))}
    if "state_file" in step:
        known["state_file"] = checks.name("state_file", step["state_file"])
        if not (path.parent / known["state_file"]).is_file():
            raise ManipError(f"no {known['state_file']} beside it")
    return known
