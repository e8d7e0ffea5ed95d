"""Export of a policy to one file that runs without this package: ONNX, for onnxruntime and others.

Its inputs are raw observations under LeRobot's names, its outputs absolute actions. Everything between, normalisation
and clipping too, is in the file. Its metadata say what the names, shapes and units mean.
"""

from __future__ import annotations

import io
import json
import re
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from manip_il.data.fingerprint import policy_sha256
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import ManipError
from manip_il.learn.batches import to_float
from manip_il.learn.names import EE_DELTA, JOINT_DELTA
from manip_il.learn.network import MLPNetwork
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import F64
from manip_il.worlds.contract import GRIPPERS, OPENINGS, SERVOS, TWO_ARMS

TOLERANCE = 1e-5  # largest difference between the actions of the file and of the checkpoint [rad] or [m]
SERVO_TOLERANCE = 1e-3  # largest difference for robots in servos' units [degrees]
_OPSET = 17
_ROWS = 64  # observations on which file and checkpoint are compared
_JOINT_UNITS = {OPENINGS: ("rad", "m"), SERVOS: ("deg", "0 to 100"), TWO_ARMS: ("rad", "0 to 1")}  # (joints, grippers)
_UNITS = {"x": "m", "y": "m", "z": "m", "width": "m", "tilt": "rad"}
_UNITLESS = re.compile(r".*\.(axis_[xyz]\.[xyz]|cos[^.]*|sin[^.]*)")

Arrays = dict[str, NDArray[Any]]


class PolicyFunction(nn.Module):
    """A policy as a function of one observation: inputs in the order of `inputs`, absolute actions (B, n) as output.

    Joint state (B, n) and environment state (B, k) are float32, pictures uint8 (B, H, W, 3), as cameras give them.
    """

    def __init__(self, policy: LearnedPolicy) -> None:
        super().__init__()
        self.numbers = [key for key in (STATE, ENVIRONMENT_STATE) if key in policy.checkpoint.numbers]
        self.cameras = sorted(IMAGES + camera for camera in policy.cameras)
        self.inputs = [*self.numbers, *self.cameras]
        self.policy: Any = policy.module
        self.network: MLPNetwork = self.policy.model if self.cameras else self.policy
        self.requires_grad_(False).eval()

    @override
    def forward(self, *observations: Tensor) -> Tensor:
        batch = dict(zip(self.inputs, observations, strict=True))
        if not self.cameras:
            return self.network.actions(torch.cat(observations, dim=1))
        pictures = {key: to_float(batch[key].permute(0, 3, 1, 2)) for key in self.cameras}
        return self.network.actions(self.policy.network_inputs({**batch, **pictures}))


def export_onnx(path: Path) -> tuple[bytes, float]:
    """Return a `pretrained_model` folder's policy as ONNX, and the largest change that the export makes to an action.

    Raises `ManipError` for a policy that cannot be exported or whose file would act differently from the checkpoint,
    and what `LearnedPolicy.load` raises.
    """
    import onnx
    import onnxruntime

    policy = LearnedPolicy.load(path)
    if policy.checkpoint.space == EE_DELTA:
        raise ManipError(
            f"{path} was trained with {EE_DELTA}, whose inverse kinematics cannot be exported; train with {JOINT_DELTA}"
        )
    function = PolicyFunction(policy)
    metadata = file_metadata(policy, function.inputs, policy_sha256(path))
    example = _observations(policy, function, rows=2)
    content = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):
        # Torch's preferred exporter needs two more packages and gives the same graph.
        torch.onnx.export(
            function,
            tuple(map(torch.from_numpy, example.values())),
            content,  # pyright: ignore[reportArgumentType]  # the parameter takes any writable file
            input_names=list(example),
            output_names=[ACTION],
            dynamic_axes={name: {0: "batch"} for name in (*example, ACTION)},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(content.getvalue())
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = policy.checkpoint.action
    texts = {key: value if isinstance(value, str) else json.dumps(value) for key, value in metadata.items()}
    onnx.helper.set_model_props(model, texts)
    model.producer_name = "manip-il"
    onnx.checker.check_model(model, full_check=True)
    data = model.SerializeToString()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    observation = _observations(policy, function, _ROWS)
    difference = float(
        np.abs(np.asarray(session.run(None, observation)[0]) - _actions(policy, function, observation)).max()
    )
    meta = policy.checkpoint.origin
    tolerance = SERVO_TOLERANCE if meta and meta.action_meaning == SERVOS else TOLERANCE
    if not difference <= tolerance:
        raise ManipError(
            f"{path}: the exported file's actions differ by up to {difference:.2g} from the checkpoint's; expected at "
            f"most {tolerance:g}, so nothing was written"
        )
    return data, difference


def file_metadata(policy: LearnedPolicy, inputs: Sequence[str], sha256: str) -> dict[str, Any]:
    """Return the ONNX file's metadata: policy, robot, task, inputs and outputs; unknown entries are left out."""
    shared = ("robot", "robot"), ("task", "task"), ("control_rate_hz", "fps"), ("action_meaning", "action_meaning")
    config = policy.checkpoint.config
    entries: dict[str, Any] = {
        **{key: getattr(policy.checkpoint.origin, name, None) for key, name in shared},
        "inputs": [_entry(policy, key) for key in inputs],
        "outputs": [_entry(policy, ACTION)],
        "policy_type": config["type"],
        "policy_loss": config.get("loss"),
        "policy_sha256": sha256,
    }
    return {key: value for key, value in entries.items() if value is not None}


def _entry(policy: LearnedPolicy, key: str) -> dict[str, Any]:
    """Return the name, type and shape of an input or output, and what its numbers mean, if known."""
    checkpoint, meta = policy.checkpoint, policy.checkpoint.origin
    if key.startswith(IMAGES):
        shape = ["batch", *checkpoint.pictures[key.removeprefix(IMAGES)], 3]
        return {"name": key, "dtype": "uint8", "shape": shape, "names": ["red", "green", "blue"], "units": "0 to 255"}
    size = checkpoint.action if key == ACTION else checkpoint.numbers[key]
    names: list[str] = []
    if meta:
        names = list(meta.environment_state_names if key == ENVIRONMENT_STATE else meta.joint_names)
    meaning = meta.action_meaning if meta else OPENINGS
    grippers = [place % size for place in GRIPPERS.get(meaning, (-1,))]
    units = [_JOINT_UNITS[meaning][place in grippers] for place in range(size)] if meaning in _JOINT_UNITS else []
    if key == ENVIRONMENT_STATE:
        units = ["1" if _UNITLESS.fullmatch(name) else _UNITS.get(name.rpartition(".")[2]) for name in names]
    meanings = {name: values for name, values in (("names", names), ("units", units)) if values}
    return {"name": key, "dtype": "float32", "shape": ["batch", size], **meanings}


def _observations(policy: LearnedPolicy, function: PolicyFunction, rows: int) -> Arrays:
    """Return random observations, distributed as in the training data."""
    rng = np.random.default_rng(0)
    widths = [policy.checkpoint.numbers[key] for key in function.numbers]
    network, size = function.network, sum(widths)
    mean, scale = network.input_mean[:size].numpy(), network.input_scale[:size].numpy()
    deviation = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    numbers = (mean + deviation * rng.normal(size=(rows, size))).astype(np.float32)
    parts = np.split(numbers, np.cumsum(widths)[:-1], axis=1)
    sizes = {key: policy.checkpoint.pictures[key.removeprefix(IMAGES)] for key in function.cameras}
    pictures = {key: rng.integers(256, size=(rows, *size, 3), dtype=np.uint8) for key, size in sizes.items()}
    return dict(zip(function.numbers, parts, strict=True)) | pictures


def _actions(policy: LearnedPolicy, function: PolicyFunction, observation: Arrays) -> F64:
    """Return the checkpoint's actions, (B, n)."""
    images = {key.removeprefix(IMAGES): observation[key] for key in function.cameras}
    around = observation.get(ENVIRONMENT_STATE, np.empty((len(observation[STATE]), 0), np.float32))
    return policy.act(observation[STATE], around, images)
