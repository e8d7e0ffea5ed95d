"""How bright pictures are, held loosely against their stored statistics, which are of a sample of them."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import Feature
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, error
from manip_il.doctor.stored import stored

_TOLERANCE = 0.1  # of the range of levels: LeRobot samples frames and pixels, before they are compressed with loss


class Brightness:
    """The mean level of every channel, in [0, 1], of the pictures that are added."""

    def __init__(self) -> None:
        self._sum = np.zeros(3)
        self._pictures = 0

    def add(self, picture: NDArray[np.generic]) -> None:
        """Take one RGB picture, (height, width, 3) of uint8."""
        self._sum += picture.reshape(-1, 3).mean(axis=0) / 255
        self._pictures += 1

    @property
    def mean(self) -> NDArray[np.float64] | None:
        """(3,); None of no picture."""
        return self._sum / self._pictures if self._pictures else None


def check_brightness(dataset: Dataset, feature: Feature, brightness: Brightness) -> Iterator[Finding]:
    """Yield the stored mean is about that of the pictures, and lies between the stored minimum and maximum."""
    stats = dataset.stats
    if stats is None or not isinstance(stats.get(feature.key), dict) or feature.details.get("is_depth_map"):
        return
    place = f"{layout.STATS}: {feature.key}"
    low, mean, high = (stored(stats, feature.key, name) for name in ("min", "mean", "max"))
    if low is None or mean is None or high is None or not len(low) == len(mean) == len(high) == feature.channels:
        yield error(place, f"min, mean and max are not one number for each of {feature.channels} channels")
        return
    if not ((low <= mean) & (mean <= high) & (low >= 0) & (high <= 1)).all():
        yield error(place, f"mean {_text(mean)} is not between min {_text(low)} and max {_text(high)} in [0, 1]")
    found = brightness.mean
    if found is not None and len(mean) == 3 and (np.abs(found - mean) > _TOLERANCE).any():
        yield error(place, f"mean is {_text(mean)}; the pictures' is {_text(found)}")


def _text(values: NDArray[np.float64]) -> str:
    return "(" + ", ".join(f"{value:.3g}" for value in values) + ")"
