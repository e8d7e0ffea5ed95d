"""Which messages make up a frame: stamped values brought to a dataset's rate, gaps refused."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError

I64 = NDArray[np.int64]
F64 = NDArray[np.float64]
Method = Literal["nearest", "hold", "interpolate"]

NANOSECONDS = 1_000_000_000


@dataclass(frozen=True)
class Pick:
    """For each of T frames the message before and the one after, and how far (0 to 1) the frame is on the way."""

    left: I64
    right: I64  # equal to `left` where one message is taken as it is
    weight: F64

    def blend(self, values: NDArray[Any]) -> NDArray[Any]:
        """Return values (T, ...) of the frames from values (N, ...) of the messages.

        Untouched where one is taken as it is.
        """
        left, right = values[self.left], values[self.right]
        if (self.left == self.right).all():
            return left
        weight = self.weight.reshape(-1, *[1] * (values.ndim - 1))
        between = np.clip(left + (right - left) * weight, np.minimum(left, right), np.maximum(left, right))
        return np.where(weight == 0, left, between)

    def used(self) -> I64:
        """Which messages had a part in some frame, ascending."""
        return np.union1d(self.left, self.right)


def frame_times(start: int, end: int, fps: int) -> I64:
    """Stamps [ns] of frames at `fps` from `start` on, none later than `end`."""
    count = ((end - start + 1) * fps - 1) // NANOSECONDS + 1
    return np.array([start + frame * NANOSECONDS // fps for frame in range(count)], dtype=np.int64)


def pick(who: str, method: Method, stamps: I64, times: I64, tolerance: float) -> Pick:
    """Choose messages for frames at `times`, both [ns] and ascending, `stamps` strictly.

    nearest: the one with the smallest distance in time, the earlier of two; at most `tolerance` [s] away.
    hold: the last one not later than the frame; at most `tolerance` old.
    interpolate: the two around the frame, at most `tolerance` apart; one alone where it has the frame's stamp.
    Raises `ManipError` with `who`, both times and the tolerance for the first frame that has none.
    """
    limit = tolerance * NANOSECONDS
    before = np.searchsorted(stamps, times, side="right") - 1  # -1: none
    after = np.minimum(before + 1, len(stamps) - 1)
    left = np.maximum(before, 0)
    to_left, to_right = np.abs(times - stamps[left]), np.abs(stamps[after] - times)
    right = left
    if method == "nearest":
        left = right = np.where(to_left <= to_right, left, after)
        bad = np.minimum(to_left, to_right) > limit
    elif method == "hold":
        bad = (before < 0) | (to_left > limit)
    else:
        right = np.where(to_left == 0, left, after)
        bad = (before < 0) | (stamps[right] - stamps[left] > limit) | (stamps[right] < times)
    if bad.any():
        raise _gap(who, method, stamps, times, int(np.argmax(bad)), tolerance)
    span = np.maximum(stamps[right] - stamps[left], 1)
    return Pick(left, right, np.where(left == right, 0.0, to_left / span))


def _gap(who: str, method: Method, stamps: I64, times: I64, frame: int, tolerance: float) -> ManipError:
    time = times[frame]
    around = [f"{(time - stamps[stamps <= time][-1]) / NANOSECONDS:g} s before"] if (stamps <= time).any() else []
    around += [f"{(stamps[stamps > time][0] - time) / NANOSECONDS:g} s after"] if (stamps > time).any() else []
    return ManipError(
        f"{who}: a gap at {(time - times[0]) / NANOSECONDS:g} s (stamp {time} ns, frame {frame}): "
        f"the messages next to it are {' and '.join(around)}, {method} allows {tolerance:g} s; "
        "raise its tolerance in the mapping, or leave out this file"
    )
