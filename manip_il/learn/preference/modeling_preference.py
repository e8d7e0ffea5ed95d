"""The `preference` reward model: LeRobot's interface to `RewardNetwork`, and how its folder is written."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict
from pathlib import Path
from typing import Any, override

import torch
from lerobot.configs import FeatureType, PolicyFeature
from lerobot.rewards.pretrained import PreTrainedRewardModel
from torch import Tensor

from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, RobotTaskSpec
from manip_il.learn.checkpoint import META_FILE, Origin
from manip_il.learn.preference.configuration_preference import PreferenceConfig
from manip_il.learn.preference.network import RewardNetwork, RewardShape


class PreferenceRewardModel(PreTrainedRewardModel):
    """LeRobot's interface to `RewardNetwork`.

    Batches hold `observation.state` (B, n), `observation.environment_state` (B, k) and `action` (B, n): the one that
    was carried out, where a dataset has another one beside it.
    """

    config_class = PreferenceConfig  # type: ignore[assignment]
    name = "preference"  # type: ignore[assignment]

    def __init__(self, config: PreferenceConfig, **_: Any) -> None:
        super().__init__(config)
        config.validate_features()
        width = sum(config.input_features[key].shape[0] for key in (STATE, ENVIRONMENT_STATE, ACTION))
        self.model = RewardNetwork(width, config.network_shape())

    @override
    @torch.no_grad()
    def compute_reward(self, batch: dict[str, Tensor]) -> Tensor:
        """Return the reward of every row, (B,)."""
        return self.model(torch.cat([batch[key] for key in (STATE, ENVIRONMENT_STATE, ACTION)], dim=-1))


def write_reward(
    folder: Path,
    network: RewardNetwork,
    shape: RewardShape,
    spec: RobotTaskSpec,
    options: Mapping[str, Any],
    fingerprint: Mapping[str, Any],
) -> None:
    """Write a `pretrained_model` folder: config.json, model.safetensors, and for what it was trained, manip_il.json.

    options: of the fit. Raises `OSError` where it cannot be written.
    """
    n, k = len(spec.joint_names), len(spec.environment_state_names)
    kinds = {STATE: (FeatureType.STATE, n), ENVIRONMENT_STATE: (FeatureType.ENV, k), ACTION: (FeatureType.ACTION, n)}
    features = {key: PolicyFeature(type=kind, shape=(size,)) for key, (kind, size) in kinds.items()}
    reward = PolicyFeature(type=FeatureType.REWARD, shape=(1,))
    sizes: dict[str, Any] = asdict(shape) | {"ways": [list(way) for way in shape.ways], "unread": list(shape.unread)}
    made = PreferenceConfig(input_features=features, output_features={"reward": reward}, **sizes)
    model = PreferenceRewardModel(made)
    model.model.load_state_dict(network.state_dict())
    model.save_pretrained(folder)
    origin = Origin.of(spec, fingerprint, options).to_json()
    (folder / META_FILE).write_text(json.dumps(origin, indent=2) + "\n", encoding="utf-8")
