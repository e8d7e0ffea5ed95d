"""LeRobot's pre- and post-processors for the `mlp` policy."""

from __future__ import annotations

from typing import Any

from lerobot.processor import PolicyProcessorPipeline, make_default_pre_post_processors

from manip_il.learn.mlp.configuration_mlp import MLPConfig


def make_mlp_pre_post_processors(
    config: MLPConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """Return LeRobot's default pair: rename, batch (B, ...), device, normalise; and back.

    `config.normalization_mapping` makes the normaliser steps the identity. They stay in the
    pipelines because LeRobot's tools override them by name.
    """
    return make_default_pre_post_processors(config, dataset_stats, normalizer_device=config.device)
