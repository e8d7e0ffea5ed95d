"""One or more datasets as one training set, with the metadata attributes that LeRobot's factories expect."""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.dataset import Dataset
from manip_il.data.info import PICTURES
from manip_il.data.lerobot_layout import Features
from manip_il.data.statistics import Statistics, pool
from manip_il.mdp import I64

# from LeRobot, for every camera
_IMAGENET = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}


class JoinedDatasets:
    """Several datasets; frames are numbered in the given order.

    features: LeRobot's table of the columns and cameras that every dataset has, with equal shapes and without depth.
    stats: over all frames. Cameras have ImageNet's mean and std, as in `lerobot-train`; their other statistics are the
    first dataset's. tasks: each text once.
    """

    table: dict[str, NDArray[Any]]  # numeric columns, once training has read them

    def __init__(self, datasets: Sequence[Dataset]):
        self.datasets, first = tuple(datasets), datasets[0]
        self.roots = tuple(one.root for one in datasets)
        self.repo_id, self.fps = f"local/{first.root.name}", first.fps
        self.features: Features = {
            key: {"dtype": one.dtype, "shape": one.shape, "names": one.names}
            for key, one in first.features.items()
            if all(key in other.features and other.features[key].shape == one.shape for other in self.datasets)
            and (one.is_rgb or one.dtype not in PICTURES)
        }
        self.camera_keys = [key for key, one in self.features.items() if one["dtype"] in PICTURES]
        self.total_frames = sum(map(len, self.datasets))
        self.stats = self._statistics()
        self.tasks = list(dict.fromkeys(text for one in self.datasets for text in one.tasks.values()))

    def joint_tasks(self, own: I64) -> I64:
        """Return every frame's index in `tasks`, (N,), given its `task_index` in its own dataset, (N,).

        Raises `ManipError` for an index without a text.
        """
        places = {text: place for place, text in enumerate(self.tasks)}
        pieces = np.split(own, np.cumsum([*map(len, self.datasets)])[:-1])
        texts = [dataset.texts(piece) for dataset, piece in zip(self.datasets, pieces, strict=True)]
        return np.array([places[text] for text in itertools.chain(*texts)])

    def _statistics(self) -> Statistics:
        pooled = reduce(pool, (one.statistics for one in self.datasets))
        numbers = {key: pooled[key] for key in self.features if key in pooled}
        imagenet = {name: np.array(values, np.float32).reshape(3, 1, 1) for name, values in _IMAGENET.items()}
        cameras = {key: self.datasets[0].statistics.get(key, {}) | imagenet for key in self.camera_keys}
        return numbers | cameras
