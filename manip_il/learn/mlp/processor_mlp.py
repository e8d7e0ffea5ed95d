"""LeRobot's pre- and post-processors for the `mlp` policy."""

from __future__ import annotations

from typing import Any

import torch
from lerobot.processor import PolicyAction, PolicyProcessorPipeline, make_default_pre_post_processors

from manip_il.learn.mlp.configuration_mlp import MLPConfig


def make_mlp_pre_post_processors(
    config: MLPConfig, dataset_stats: dict[str, dict[str, torch.Tensor]] | None = None
) -> tuple[
    PolicyProcessorPipeline[dict[str, Any], dict[str, Any]],
    PolicyProcessorPipeline[PolicyAction, PolicyAction],
]:
    """Return LeRobot's default pair: rename, batch (B, ...), device, normalise; and back.

    `config.normalization_mapping` makes the normaliser steps the identity. They stay in the
    pipelines because LeRobot's tools override them by name.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
