"""Episodes with a known progress, and clips of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from manip_il.data import schema as s
from manip_il.mdp import Episode
from manip_il.preferences.pairs import Clips, choose_pairs


def brought(episode: Episode, spec: s.RobotTaskSpec, well: bool) -> Episode:
    """The episode with its object on the way from 0 to 1, all of it or a third and back; progress is how far it is."""
    rng, steps = np.random.default_rng(episode.seed), len(episode)
    way = np.linspace(0, 1, steps) if well else 0.35 * np.sin(np.linspace(0, np.pi, steps))
    place = way + rng.normal(size=steps) * 0.01
    columns = {key: values.copy() for key, values in episode.columns.items()}
    columns[s.ENVIRONMENT_STATE][:, spec.environment_state_names.index("object.x")] = place
    columns[s.PROGRESS] = place.clip(0, 1).astype(np.float32)[:, None]
    return replace(episode, columns=columns)


def clips_of(roots: Sequence[Path], count: int, length: int = 10, seed: int = 0) -> Clips:
    return choose_pairs(list(roots), length, count, seed, np.random.default_rng(seed))
