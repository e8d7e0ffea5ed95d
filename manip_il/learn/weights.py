"""Weights of samples from progress, by LeRobot's RA-BC (Chen et al. 2025, arXiv:2509.25358, equations 8 and 9).

LeRobot multiplies losses with these weights, normalised in each batch; here samples are drawn in proportion to them,
which follows the same gradient without computing what has no weight.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch
from lerobot.rewards.sarm.rabc import RABCWeights
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError, MismatchError


def rabc_weights(path: Path, episodes: NDArray[np.int64], ahead: int) -> NDArray[np.float64]:
    """Return the weight of every frame, (N,), 1 at most, by the progress in a file.

    episodes: the dataset's `episode_index`, (N,). ahead: frames that an action reaches. Raises `ManipError` for a file
    that is no such table and if every frame weighs 0, `MismatchError` for one of another dataset.
    """
    try:
        found = RABCWeights(path, chunk_size=ahead, device=torch.device("cpu"))
    except Exception as error:  # of every kind: a file of the user's, read by pandas
        raise ManipError(f"{path} is no file of weights: {checks.one_line(error)}") from error
    if found.episode_lookup != dict(enumerate(episodes.tolist())):
        frames = f"{len(found.episode_lookup)} frames"
        raise MismatchError("episodes", str(path), frames, "the dataset", f"{len(episodes)} frames")
    weights, _ = found.compute_batch_weights({"index": np.arange(len(episodes))})
    if not weights.any():
        raise ManipError(f"all {len(weights)} frames weigh 0: progress falls from each of them; nothing to learn from")
    return (weights / weights.max()).double().numpy()
