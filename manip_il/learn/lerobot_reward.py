"""Scores of a dataset's frames by any reward model that LeRobot's factory makes (SARM, TOPReward, ...)."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.data.joined import JoinedDatasets
from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.batches import to_float
from manip_il.learn.samples import Pictures, Samples, Windows
from manip_il.learn.threads import threads

_BATCH = 32


def score_by_lerobot(
    root: Path, folder: Path, *, trust: bool, on_frames: Callable[[int], None] = lambda count: None
) -> NDArray[np.float64]:
    """Return the reward of every frame of a dataset by LeRobot's reward model in a `pretrained_model` folder, (N,).

    Such models load encoders by the names that their configuration holds, which may run code: `trust` says that this is
    wanted. Raises `ManipError` without it, and for a model that cannot be loaded or does not fit the dataset.
    """
    if not trust:
        raise ManipError(
            f"{folder} is a reward model of LeRobot's, which loads models by name and may run code that comes with "
            "them; if you trust its source, add --trust=true"
        )
    meta = JoinedDatasets([root])
    config, model, preprocessor = _load(folder, meta)
    features = [key for key in config.input_features if key != "task"]
    if missing := [key for key in features if key not in meta.features]:
        raise ManipError(f"{root} lacks {', '.join(missing)}, which the reward model in {folder} sees")
    deltas = config.observation_delta_indices
    ahead = {} if deltas is None else {key: np.asarray(deltas, np.int64) for key in features}
    dataset = Dataset.open(root)
    table = dataset.columns([key for key, feature in meta.features.items() if feature["dtype"] in NUMBERS])
    samples = Samples(
        Windows(table[EPISODE_INDEX].reshape(-1), ahead),
        {key: torch.from_numpy(column.copy()) for key, column in table.items()},
        {key: Pictures.decode([dataset], key) for key in meta.camera_keys},
        np.array(meta.tasks, object),
    )
    found: list[torch.Tensor] = []
    with threads(1), torch.inference_mode():
        for start in range(0, meta.total_frames, _BATCH):
            batch = samples.batch(np.arange(start, min(start + _BATCH, meta.total_frames)))
            pictured = {key: to_float(one) for key, one in batch.items() if _is_picture(one)}
            rewards = model.compute_reward(preprocessor(batch | pictured)).reshape(-1).cpu()
            found.append(rewards)
            on_frames(len(rewards))
    scores = torch.cat(found).double().numpy()
    if len(scores) != meta.total_frames:
        raise MismatchError("frames", str(root), meta.total_frames, f"the rewards of {folder}", len(scores))
    if not np.isfinite(scores).all():
        raise ManipError(f"{folder}: the reward of frame {int(np.argmin(np.isfinite(scores)))} is not finite")
    return scores


def _load(folder: Path, meta: Any) -> tuple[Any, Any, Any]:
    """LeRobot's configuration, model and preprocessor; what its packages raise, in one line."""
    from lerobot.configs.rewards import RewardModelConfig
    from lerobot.rewards import make_reward_model, make_reward_pre_post_processors

    try:
        config = RewardModelConfig.from_pretrained(str(folder), local_files_only=True)
        config.pretrained_path = str(folder)
        model = make_reward_model(config)
        preprocessor, _ = make_reward_pre_post_processors(config, dataset_stats=meta.stats, dataset_meta=meta)
    except Exception as error:  # of every kind: a missing package, weights that are not here, a bad configuration
        line = checks.shorten(" ".join(str(error).split()))
        raise ManipError(
            f"LeRobot cannot load the reward model in {folder} ({type(error).__name__}: {line})"
        ) from error
    return config, model.eval(), preprocessor


def _is_picture(values: Any) -> bool:
    return isinstance(values, torch.Tensor) and values.dtype == torch.uint8
