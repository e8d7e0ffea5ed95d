"""Export of a policy to one file that runs without this package: ONNX, for onnxruntime and others.

Its inputs are raw observations under LeRobot's names, its outputs absolute actions. Everything
between, normalisation and clipping too, is in the file. Its metadata say what the names and shapes
mean.
"""

import io
import json
import warnings
from pathlib import Path
from typing import Any, override

import numpy as np
import torch
from torch import Tensor, nn

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import ManipError
from manip_il.learn.batches import to_float
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.names import EE_DELTA, JOINT_DELTA
from manip_il.learn.network import MLPNetwork
from manip_il.learn.policy import LearnedPolicy
from manip_il.mdp import F32, Images
from manip_il.worlds.contract import SERVOS

# largest difference between the actions of the file and of the checkpoint [rad] or [m]
TOLERANCE = 1e-5
SERVO_TOLERANCE = 1e-3  # largest difference for robots in servos' units [degrees]
_OPSET = 17
_ROWS = 64  # observations on which the graph is traced, and file and checkpoint are compared


class PolicyFunction(nn.Module):
    """A policy as a function of one observation: inputs in the order of `inputs`, absolute actions
    (B, n) as output.

    Joint state (B, n) and environment state (B, k) are float32, pictures uint8 (B, H, W, 3), as
    cameras give them.
    """

    def __init__(self, policy: LearnedPolicy) -> None:
        super().__init__()
        numbers = [key for key in (STATE, ENVIRONMENT_STATE) if key in policy.checkpoint.numbers]
        self.cameras = sorted(IMAGES + camera for camera in policy.cameras)
        self.inputs = [*numbers, *self.cameras]
        self.policy: Any = policy.module
        self.network: MLPNetwork = self.policy.model if self.cameras else self.policy
        self.requires_grad_(False).eval()

    @override
    def forward(self, *observations: Tensor) -> Tensor:
        if not self.cameras:
            return self.network.actions(torch.cat(observations, dim=1))
        batch = dict(zip(self.inputs, observations, strict=True))
        pictures = {key: to_float(batch[key].permute(0, 3, 1, 2)) for key in self.cameras}
        return self.network.actions(self.policy.network_inputs({**batch, **pictures}))


def export_onnx(checkpoint: Checkpoint | Path) -> tuple[bytes, float]:
    """Return a policy as ONNX, and the largest change of an action by that.

    Args:
        checkpoint: The policy, or its `pretrained_model` folder.

    Returns:
        The content of the file, and the change [rad], [m] or, for robots in servos' units,
        [degrees].

    Raises:
        ManipError: The policy cannot be loaded or exported, or its file would act differently from
            the checkpoint.
    """
    import onnx
    import onnxruntime

    policy = LearnedPolicy.load(checkpoint)
    checkpoint = policy.checkpoint
    path, meta = checkpoint.path, checkpoint.origin
    if checkpoint.space == EE_DELTA:
        raise ManipError(
            f"{path} was trained with {EE_DELTA}, whose inverse kinematics cannot be exported;"
            f" train with {JOINT_DELTA}"
        )
    if checkpoint.config.get("reads_text"):
        raise ManipError(
            f"{path} reads the task's text, which the file would not; train a policy on one task"
        )
    function = PolicyFunction(policy)
    states, around, images = _random_observations(function.network, checkpoint)
    pictures = {IMAGES + camera: picture for camera, picture in images.items()}
    observations = {STATE: states, ENVIRONMENT_STATE: around, **pictures}
    inputs = {key: observations[key] for key in function.inputs}
    content = io.BytesIO()
    with warnings.catch_warnings(action="ignore"):
        # Torch's preferred exporter needs two more packages and gives the same graph.
        torch.onnx.export(
            function,
            tuple(map(torch.from_numpy, inputs.values())),
            content,  # pyright: ignore[reportArgumentType]  # the parameter takes any writable file
            input_names=function.inputs,
            output_names=[ACTION],
            dynamic_axes={name: {0: "batch"} for name in (*function.inputs, ACTION)},
            opset_version=_OPSET,
            dynamo=False,
        )
    model = onnx.load_model_from_string(content.getvalue())
    model.graph.output[0].type.tensor_type.shape.dim[1].dim_value = checkpoint.action
    onnx.helper.set_model_props(model, metadata(checkpoint))
    model.producer_name = "manip-il"
    onnx.checker.check_model(model, full_check=True)
    data = model.SerializeToString()
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    actions = np.asarray(session.run(None, inputs)[0])
    difference = float(np.abs(actions - policy.act(states, around, images)).max())
    tolerance = SERVO_TOLERANCE if meta and meta.action_meaning == SERVOS else TOLERANCE
    if not difference <= tolerance:
        raise ManipError(
            f"{path}: the exported file's actions differ by up to {difference:.2g} from the"
            f" checkpoint's; expected at most {tolerance:g}, so nothing was written"
        )
    return data, difference


def metadata(checkpoint: Checkpoint) -> dict[str, str]:
    """Return the ONNX file's metadata: the policy and, if known, robot, task, rate, the meaning of
    actions, and the names of the numbers of inputs and output as JSON.
    """
    origin = checkpoint.origin
    entries = {
        "policy_type": checkpoint.kind,
        "policy_loss": str(checkpoint.config["loss"]),
        "policy_sha256": checkpoint.sha256,
    }
    if origin is None:
        return entries
    names = {
        STATE: origin.state_names or origin.joint_names,
        ENVIRONMENT_STATE: origin.environment_state_names,
        ACTION: origin.joint_names,
    }
    known = {key: names[key] for key in names if key in (*checkpoint.numbers, ACTION)}
    return entries | {
        "robot": origin.robot,
        "task": origin.task,
        "action_meaning": origin.action_meaning,
        "control_rate_hz": str(origin.fps),
        "names": json.dumps(known),
    }


def _random_observations(network: MLPNetwork, checkpoint: Checkpoint) -> tuple[F32, F32, Images]:
    """Return joint states, environment states and pictures, distributed as in the training data."""
    rng = np.random.default_rng(0)
    joints = checkpoint.numbers[STATE]
    size = sum(checkpoint.numbers.values())
    mean, scale = network.input_mean[:size].numpy(), network.input_scale[:size].numpy()
    deviation = np.divide(1.0, scale, out=np.zeros_like(scale), where=scale > 0)
    numbers = (mean + deviation * rng.normal(size=(_ROWS, size))).astype(np.float32)
    pictures = {
        camera: rng.integers(256, size=(_ROWS, *shape, 3), dtype=np.uint8)
        for camera, shape in checkpoint.pictures.items()
    }
    return numbers[:, :joints], numbers[:, joints:], pictures
