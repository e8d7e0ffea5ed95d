"""Checkpoints of LeRobot's policies, small and untrained, as LeRobot itself writes them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.configs import FeatureType
from lerobot.policies.factory import get_policy_class, make_policy_config, make_pre_post_processors

from manip_il.data.schema import ENVIRONMENT_STATE, STATE, features
from manip_il.errors import ManipError
from manip_il.learn.checkpoint import Origin
from manip_il.learn.lerobot_config import policy_features, policy_types
from manip_il.learn.policy import LearnedPolicy
from manip_il.worlds.contract import EnvironmentSpec

ACT = {  # a policy that plans, by its options
    "type": "act",
    "device": "cpu",
    "chunk_size": 4,
    "n_action_steps": 2,
    "dim_model": 16,
    "n_heads": 2,
    "dim_feedforward": 16,
    "n_encoder_layers": 1,
    "n_vae_encoder_layers": 1,
}

DIFFUSION = {  # one that draws
    "type": "diffusion",
    "device": "cpu",
    "horizon": 8,
    "n_action_steps": 4,
    "down_dims": [8, 16],
    "n_groups": 4,
    "diffusion_step_embed_dim": 8,
    "num_train_timesteps": 10,
}
CNN = {"type": "cnn", "channels": [4, 8], "keypoints": 4, "width": 8, "device": "cpu"}

TINY: dict[str, dict[str, Any]] = {
    "act": (
        ACT
        | {
            "use_vae": False,
            "chunk_size": 5,
            "n_action_steps": 3,
            "pretrained_backbone_weights": None,
        }
    ),
    "diffusion": DIFFUSION | {"num_inference_steps": 2, "pretrained_backbone_weights": None},
}


def write_checkpoint(
    folder: Path,
    kind: str,
    spec: EnvironmentSpec,
    observation: str = "state",
    *,
    origin: Origin | None = None,
    **options: Any,
) -> Path:
    """A `pretrained_model` folder for data of `spec`.

    Without `origin` as lerobot-train leaves it.
    """
    policy_types()  # registers all of them
    settings = {"device": "cpu", "push_to_hub": False} | TINY.get(kind, {}) | options
    config = make_policy_config(
        kind, **{name: value for name, value in settings.items() if name != "type"}
    )
    inputs = [STATE, *([ENVIRONMENT_STATE] if observation != "images" else [])]
    inputs += list(spec.image_keys) if observation != "state" else []
    config.input_features, config.output_features = policy_features(features(spec), inputs)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        policy = get_policy_class(kind)(config)
    folder.mkdir(parents=True, exist_ok=True)
    policy.save_pretrained(folder)
    for processor in make_pre_post_processors(config, dataset_stats=_statistics(config)):
        processor.save_pretrained(folder)
    if origin is not None:
        origin.write(folder)
    return folder


def observations(rows: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Joint states (rows, 4) and environment states (rows, 6) of noise."""
    rng = np.random.default_rng(seed)
    return rng.normal(size=(rows, 4)).astype(np.float32), rng.normal(size=(rows, 6)).astype(
        np.float32
    )


def refused(policy: Path, words: str, longest: int = 1_000) -> None:
    """Check that a policy is refused in one line."""
    with pytest.raises(ManipError, match=words) as caught:
        LearnedPolicy.load(policy)
    assert "\n" not in str(caught.value)
    assert len(str(caught.value)) < longest


def edit_config(folder: Path, **changes: Any) -> None:
    """Change entries of `config.json`."""
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


def _statistics(config: Any) -> dict[str, dict[str, torch.Tensor]]:
    stats: dict[str, dict[str, torch.Tensor]] = {}
    for key, feature in (config.input_features | config.output_features).items():
        shape = (3, 1, 1) if feature.type is FeatureType.VISUAL else feature.shape
        one = torch.ones(shape)
        stats[key] = {"mean": 0.1 * one, "std": 0.3 * one, "min": -one, "max": one}
    return stats
