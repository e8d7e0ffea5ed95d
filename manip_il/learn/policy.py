"""A checkpoint that acts: the one interface a rollout needs."""

from __future__ import annotations

import contextlib
import io
import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors.torch import load_file

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE
from manip_il.errors import ManipError, MismatchError, NotFiniteError
from manip_il.learn.checkpoint import CheckpointMeta, read_meta
from manip_il.learn.network import MLPNetwork, Shape
from manip_il.learn.threads import threads

_PROCESSORS = ("policy_preprocessor.json", "policy_postprocessor.json")
_IMAGES = "observation.images."
Batch = dict[str, torch.Tensor]


class LearnedPolicy:
    """Actions from a LeRobot checkpoint, for many environments at once.

    meta: what the policy was trained for, None for a checkpoint of lerobot-train. widths: numbers
    in each observation that the policy looks at. cameras: whose pictures it looks at.
    """

    def __init__(
        self,
        select: Callable[[Batch], torch.Tensor],
        forget: Callable[[], None],
        widths: dict[str, int],
        meta: CheckpointMeta | None,
        cameras: Sequence[str] = (),
    ):
        self.widths, self.meta, self.cameras = widths, meta, tuple(cameras)
        self._select, self._forget = select, forget
        self._rows: int | None = None

    @classmethod
    def load(cls, path: Path, device: str = "cpu") -> LearnedPolicy:
        """Any LeRobot `pretrained_model` folder, without a network. Reads JSON and safetensors alone.

        The mlp is read without LeRobot, whose import takes seconds; another policy by LeRobot's own
        factory. Raises `ManipError` for a folder that is not whole, whose files do not belong
        together, or whose processors name code to import.
        """
        path = Path(path)
        config = _read_config(path)
        features = config["input_features"].items()
        widths = {key: ft["shape"][0] for key, ft in features if ft["type"] != "VISUAL"}
        cameras = [key.removeprefix(_IMAGES) for key, ft in features if ft["type"] == "VISUAL"]
        try:
            if config["type"] == "mlp":
                select, forget = _load_mlp(path, config, widths, device)
            else:
                select, forget = _load_by_lerobot(path, device)
        except (RuntimeError, KeyError) as error:
            raise ManipError(f"{path}: weights and config.json do not belong together: {error}") from error
        return cls(select, forget, widths, read_meta(path), cameras)

    @torch.inference_mode()
    def act(
        self,
        states: NDArray[np.float32],
        environment_states: NDArray[np.float32],
        images: Mapping[str, NDArray[np.uint8]] | None = None,
    ) -> NDArray[np.float64]:
        """Absolute actions, (B, n): joint targets [rad], gripper command [m].

        states: (B, n); environment_states: (B, k); images: camera -> (B, H, W, 3). For the mlp, a
        row's action is the same bits whatever the other rows. Raises `NotFiniteError` naming the
        row, `MismatchError` for widths or cameras that are not the policy's.
        """
        batch = self._batch(states, environment_states) | self._pictures(images or {})
        if self._rows not in (None, len(states)):
            self._forget()  # a queue of chunks holds one row for each environment
        self._rows = len(states)
        with threads(1):
            actions = self._select(batch).cpu().numpy().astype(np.float64)
        _require_finite_rows("the policy's action", actions)
        return actions

    def reset(self, slots: Sequence[int] | None = None) -> None:
        """Forget the past of environments that start anew (rows of the next `act`).

        The mlp has none. LeRobot's chunk policies keep one queue for all rows: they plan anew for all.
        """
        self._forget()

    def _batch(self, states: NDArray[np.float32], environment_states: NDArray[np.float32]) -> Batch:
        batch = {}
        for key, values in ((STATE, states), (ENVIRONMENT_STATE, environment_states)):
            if key not in self.widths:
                continue
            values = np.ascontiguousarray(values, dtype=np.float32)
            expected = (len(states), self.widths[key])
            if values.shape != expected:
                raise MismatchError(f"shape of {key}", "the policy", expected, "the caller", values.shape)
            _require_finite_rows(key, values)
            batch[key] = torch.from_numpy(values)
        return batch

    def _pictures(self, images: Mapping[str, NDArray[np.uint8]]) -> Batch:
        missing = set(self.cameras) - set(images)
        if missing:
            raise MismatchError("cameras", "the policy", sorted(self.cameras), "the caller", sorted(images))
        # As LeRobot feeds them: (B, 3, H, W), from 0 to 1
        pictures = {camera: torch.from_numpy(np.ascontiguousarray(images[camera])) for camera in self.cameras}
        return {_IMAGES + camera: picture.permute(0, 3, 1, 2) / 255.0 for camera, picture in pictures.items()}


def _load_mlp(
    path: Path, config: dict[str, Any], widths: dict[str, int], device: str
) -> tuple[Callable[[Batch], torch.Tensor], Callable[[], None]]:
    shape = Shape(**{field.name: config[field.name] for field in fields(Shape)})
    network = MLPNetwork(sum(widths.values()), config["output_features"][ACTION]["shape"][0], shape)
    weights = load_file(path / "model.safetensors")
    network.load_state_dict({name.removeprefix("model."): tensor for name, tensor in weights.items()})
    network.to(device).eval()
    keys = [key for key in (STATE, ENVIRONMENT_STATE) if key in widths]

    def select(batch: Batch) -> torch.Tensor:
        # The mlp's processors are the identity (see MLPConfig), so there is nothing else to do.
        return network.act(torch.cat([batch[key] for key in keys], dim=1).to(device))

    return select, lambda: None


def _load_by_lerobot(path: Path, device: str) -> tuple[Callable[[Batch], torch.Tensor], Callable[[], None]]:
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    for name in _PROCESSORS:
        _check_steps(path / name)
    # LeRobot prints to standard output, which belongs to the caller.
    with contextlib.redirect_stdout(io.StringIO()):
        config = PreTrainedConfig.from_pretrained(path, local_files_only=True, cli_overrides=[f"--device={device}"])
        # Its weights come from the checkpoint; torchvision would download them first.
        if hasattr(config, "pretrained_backbone_weights"):
            config.pretrained_backbone_weights = None  # pyright: ignore[reportAttributeAccessIssue]
        policy = get_policy_class(config.type).from_pretrained(path, config=config, strict=True)
        overrides = {"device_processor": {"device": device}}
        before, after = make_pre_post_processors(config, str(path), preprocessor_overrides=overrides)
    return lambda batch: after(policy.select_action(before(batch))), policy.reset


def _read_config(path: Path) -> dict[str, Any]:
    for name in ("config.json", "model.safetensors"):
        if not (path / name).is_file():
            raise ManipError(f"no {name} in {path}; expected LeRobot's pretrained_model folder")
    try:
        config = json.loads((path / "config.json").read_text())
        _ = config["type"], config["input_features"].items()
    except (ValueError, KeyError, TypeError, AttributeError) as error:
        raise ManipError(f"{path / 'config.json'} is not a LeRobot policy's: {error}") from error
    return config


def _check_steps(path: Path) -> None:
    """Refuse a step by import path: LeRobot would import and call whatever a downloaded file names."""
    if not path.is_file():
        raise ManipError(f"no {path}; LeRobot's migrate_policy_normalization adds it to an old checkpoint")
    for step in json.loads(path.read_text()).get("steps", []):
        if "registry_name" not in step:
            raise ManipError(f"{path} wants to run {step.get('class')!r}; only registered steps are loaded")


def _require_finite_rows(what: str, values: NDArray[Any]) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise NotFiniteError(f"{what} in row {row} is {values[row]}: not finite")
