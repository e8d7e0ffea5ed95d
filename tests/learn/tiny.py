"""A policy that plans, as small as it gets."""

from __future__ import annotations

ACT = {
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
