"""Start a policy from another one's weights, in the units of the new data."""

from __future__ import annotations

from pathlib import Path

import torch
from safetensors import SafetensorError
from safetensors.torch import load_file

from manip_il.errors import ManipError, MismatchError
from manip_il.learn.network import MLPNetwork


@torch.no_grad()
def warm_start(network: MLPNetwork, pretrained_model: Path) -> None:
    """Copy the weights from `pretrained_model`; `network` then acts as that one did, within rounding.

    The input statistics stay those of the new data: the first layer takes up the difference. (An
    input normaliser frozen at the first round of DAgger puts later rounds' states out of scale.)
    The range of the targets is that of the new data too; their mean and scale are taken over, being
    only the unit of the outputs. Raises `MismatchError` for other shapes, `ManipError` for a file that cannot be read.
    """
    path = Path(pretrained_model) / "model.safetensors"
    try:
        saved = load_file(path)
    except (SafetensorError, OSError) as error:
        raise ManipError(f"cannot read {path} to start from its weights: {' '.join(str(error).split())}") from error
    saved = {name.removeprefix("model."): tensor for name, tensor in saved.items()}
    mean, scale = network.input_mean.clone(), network.input_scale.clone()
    low, high = network.target_low.clone(), network.target_high.clone()
    for name, ours in network.state_dict().items():
        theirs = saved[name].shape if name in saved else None
        if theirs != ours.shape:
            raise MismatchError(f"{name}'s shape", str(pretrained_model), theirs, "the new network", tuple(ours.shape))
    network.load_state_dict(saved)
    # x_old = (u - mean_old) scale_old and x = (u - mean) scale, so x_old = x scale_old / scale + offset
    first = network.layers[0]
    assert isinstance(first, torch.nn.Linear)
    offset = (mean - network.input_mean) * network.input_scale
    ratio = torch.where(scale > 0, network.input_scale / scale, torch.zeros_like(scale))
    first.bias.add_(first.weight @ offset)
    first.weight.mul_(ratio)
    network.input_mean.copy_(mean)
    network.input_scale.copy_(scale)
    network.target_low.copy_(low)
    network.target_high.copy_(high)
