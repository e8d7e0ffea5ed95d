"""LeRobot's pre- and post-processors for the `cnn` policy."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline

from manip_il.learn.cnn.configuration_cnn import CNNConfig
from manip_il.learn.mlp.processor_mlp import make_mlp_pre_post_processors


def make_cnn_pre_post_processors(
    config: CNNConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return the mlp's: rename, batch (B, ...), device, and a normaliser that is the identity.

    LeRobot looks for them by this name.
    """
    return make_mlp_pre_post_processors(config, dataset_stats)
