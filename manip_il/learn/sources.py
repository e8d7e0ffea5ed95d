"""Several datasets learnt from as one: what must agree between them, and how often each is drawn.

Statistics for normalisation are those of the union of the datasets' frames, each counted once, whatever the weights:
weights are then free to change without changing the units in which a policy sees and acts.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data.dataset import UNKNOWN_TASK
from manip_il.data.schema import RobotTaskSpec, check_same_spec
from manip_il.errors import ManipError, MismatchError
from manip_il.learn.fit_config import check_weights

F64, I64 = NDArray[np.float64], NDArray[np.int64]


@dataclass(frozen=True)
class Sources:
    """Datasets in the order in which their frames are numbered.

    frames: of each. weights: the share of the samples drawn from each, relative to the others; none where every frame
    is drawn alike. Raises `UsageError` for what `check_weights` refuses.
    """

    roots: tuple[Path, ...]
    frames: tuple[int, ...]
    weights: tuple[float, ...] = ()

    def __post_init__(self) -> None:
        check_weights(self.roots, self.weights)
        if len(self.frames) != len(self.roots):
            raise MismatchError("datasets", "their folders", len(self.roots), "their frames", len(self.frames))

    def row_weights(self, rows: I64) -> F64 | None:
        """Return how often each of the rows (S,) that are drawn from is drawn, relative to the others, (S,).

        rows: numbers of frames through all datasets. None where all are alike. Raises `ManipError` for a dataset
        without any row.
        """
        if not self.weights:
            return None
        which = np.searchsorted(np.cumsum(self.frames), rows, side="right")
        counts = np.bincount(which, minlength=len(self.roots))
        if (counts == 0).any():
            empty = self.roots[int(np.argmin(counts))]
            raise ManipError(f"{empty} has no sample to learn from, but a weight; leave it out, or hold out less of it")
        return (np.asarray(self.weights) / counts)[which]

    def to_json(self) -> list[dict[str, Any]]:
        """Return folder, frames and weight (None: by frames) of every dataset."""
        weights = self.weights or (None,) * len(self.roots)
        columns = zip(self.roots, self.frames, weights, strict=True)
        return [{"root": str(root), "frames": frames, "weight": weight} for root, frames, weight in columns]


def check_same_sources(
    roots: Sequence[Path], specs: Sequence[RobotTaskSpec], *, pictures: bool, language: bool
) -> None:
    """Raise `MismatchError` naming both sides unless datasets can be learnt from as one.

    pictures: the policy sees some, so cameras and sizes must agree, too. language: it reads which task it is to do;
    for any other the task must be the same.
    """
    what = (*(("cameras", "image_size") if pictures else ()), *(() if language else ("task",)))
    for root, spec in zip(roots[1:], specs[1:], strict=True):
        check_same_spec(str(roots[0]), specs[0], str(root), spec)
        for name in what:
            left, right = getattr(specs[0], name), getattr(spec, name)
            if left != right and UNKNOWN_TASK not in (left, right):
                raise MismatchError(name, str(roots[0]), left, str(root), right)
