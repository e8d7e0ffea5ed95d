"""LeRobot's pre- and post-processors for the `preference` reward model."""

from __future__ import annotations

from typing import Any

from lerobot.processor import (
    AddBatchDimensionProcessorStep,
    DeviceProcessorStep,
    PolicyProcessorPipeline,
    policy_action_to_transition,
    transition_to_policy_action,
)

from manip_il.learn.preference.configuration_preference import PreferenceConfig


def make_preference_pre_post_processors(
    config: PreferenceConfig, dataset_stats: dict[str, dict[str, Any]] | None = None
) -> tuple[PolicyProcessorPipeline[Any, Any], PolicyProcessorPipeline[Any, Any]]:
    """Return a pair that brings batches (B, ...) to the device and back: the network standardises for itself."""
    return (
        PolicyProcessorPipeline(
            steps=[AddBatchDimensionProcessorStep(), DeviceProcessorStep(device=config.device or "cpu")],
            name="preference_preprocessor",
        ),
        PolicyProcessorPipeline(
            steps=[DeviceProcessorStep(device="cpu")],
            name="preference_postprocessor",
            to_transition=policy_action_to_transition,
            to_output=transition_to_policy_action,
        ),
    )
