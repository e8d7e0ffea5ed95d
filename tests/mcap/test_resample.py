"""Resampling against a search through all messages."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from manip_il.errors import ManipError
from manip_il.mcap.foxglove import NANOSECONDS
from manip_il.mcap.importing import frame_times, pick
from manip_il.mcap.mapping import Method

SECOND = NANOSECONDS
stamp_lists = st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True).map(sorted)
frame_lists = st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True).map(sorted)


def expected(method: Method, stamps: list[int], time: int, tolerance: int) -> tuple[int, int, Fraction] | None:
    """Left, right and weight of one frame, or None for a gap, by looking at every message."""
    before = [number for number, stamp in enumerate(stamps) if stamp <= time]
    after = [number for number, stamp in enumerate(stamps) if stamp >= time]
    if method == "nearest":
        best = min(range(len(stamps)), key=lambda number: (abs(stamps[number] - time), number))
        return (best, best, Fraction(0)) if abs(stamps[best] - time) <= tolerance else None
    if method == "hold":
        return (before[-1], before[-1], Fraction(0)) if before and time - stamps[before[-1]] <= tolerance else None
    if not before or not after or stamps[after[0]] - stamps[before[-1]] > tolerance:
        return None
    span = stamps[after[0]] - stamps[before[-1]]
    return before[-1], after[0], Fraction(time - stamps[before[-1]], span) if span else Fraction(0)


@settings(max_examples=300)
@given(st.sampled_from(["nearest", "hold", "interpolate"]), stamp_lists, frame_lists, st.integers(0, 20))
def test_every_frame_gets_what_a_full_search_finds(
    method: Method, stamps: list[int], times: list[int], tolerance: int
) -> None:
    wanted = [expected(method, stamps, time, tolerance) for time in times]
    arrays = np.array(stamps) * SECOND, np.array(times) * SECOND
    if None in wanted:
        frame = wanted.index(None)
        with pytest.raises(
            ManipError, match=rf"f\.mcap, topic /t: a gap at {times[frame] - times[0]} s .*frame {frame}\)"
        ):
            pick("f.mcap, topic /t", method, *arrays, tolerance)
        return
    chosen = pick("f.mcap, topic /t", method, *arrays, tolerance)
    for frame, found in enumerate(wanted):
        assert found is not None
        assert (chosen.left[frame], chosen.right[frame]) == found[:2]
        assert chosen.weight[frame] == pytest.approx(float(found[2]))
    used = {number for left, right, _ in filter(None, wanted) for number in (left, right)}
    assert chosen.used().tolist() == sorted(used)


@given(st.data(), stamp_lists)
def test_a_frame_at_a_messages_stamp_is_that_message(data: st.DataObject, stamps: list[int]) -> None:
    floats = st.floats(allow_nan=False, allow_infinity=False, width=32)
    values = np.array(data.draw(st.lists(floats, min_size=len(stamps), max_size=len(stamps))))
    times = np.array(stamps) * SECOND
    for method in ("nearest", "hold", "interpolate"):
        blended = pick("x", method, times, times, 100.0).blend(values)
        assert blended.tobytes() == values.tobytes()  # bits: a minus zero is one


@given(stamp_lists, frame_lists, st.floats(-10, 10), st.floats(-10, 10))
def test_interpolation_is_exact_on_a_line(stamps: list[int], times: list[int], slope: float, offset: float) -> None:
    times = [time for time in times if stamps[0] <= time <= stamps[-1]]
    assume(times)
    line = np.outer(np.array(stamps), [slope, 2 * slope]) + offset
    chosen = pick("x", "interpolate", np.array(stamps) * SECOND, np.array(times) * SECOND, 100.0)
    np.testing.assert_allclose(chosen.blend(line), np.outer(np.array(times), [slope, 2 * slope]) + offset, atol=1e-9)


@given(st.integers(0, 2**60), st.integers(0, 3 * SECOND), st.integers(1, 120))
def test_frames_fill_the_span_at_their_rate(start: int, length: int, fps: int) -> None:
    times = frame_times(start, start + length, fps)
    assert times[0] == start
    assert times[-1] <= start + length < start + len(times) * SECOND // fps
    assert set(np.diff(times)) <= {SECOND // fps, SECOND // fps + 1}


def test_a_gap_names_its_neighbours() -> None:
    stamps, times = np.array([0, SECOND, 3 * SECOND]), np.array([0, SECOND, 2 * SECOND, 3 * SECOND])
    with pytest.raises(ManipError, match=r"1 s before and 1 s after, nearest allows 0\.5 s; raise its tolerance"):
        pick("f", "nearest", stamps, times, 0.5)
    with pytest.raises(ManipError, match=r"stamp 2000000000 ns, frame 2"):
        pick("f", "interpolate", stamps, times, 1.5)
    assert pick("f", "interpolate", stamps, times, 2.0).blend(np.array([0.0, 1.0, 3.0])).tolist() == [0, 1, 2, 3]
