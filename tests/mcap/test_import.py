"""MCAP to episodes: every value from a message that the mapping allows, or an error that says
where and when.
"""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import given, settings
from hypothesis import strategies as st

from manip_il.bridges.mcap.importing import import_files, pick, read_frames
from manip_il.bridges.mcap.mapping import TopicSource
from manip_il.errors import ManipError

from ..pictures import encoded
from .use import feature, load, ramp, write


def test_topics_of_other_rates_meet_on_the_datasets_clock(tmp_path: Path) -> None:
    fast, slow, whole = range(0, 1001, 10), range(45, 900, 50), range(5, 990, 7)
    path = write(
        tmp_path / "a.mcap",
        {"/fast": ramp(fast), "/slow": ramp(slow), "/whole": [(s, {"x": s}) for s in whole]},
    )
    held = feature("/whole", resample="previous", dtype="int64")
    rows = list(
        read_frames(
            path, load(tmp_path, {"near": feature("/fast"), "same": feature("/slow"), "held": held})
        )
    )
    times = list(range(45, 896, 100))  # from the latest first message to the earliest last one
    assert [row["same"].item() for row in rows] == times
    # the earlier of two
    assert [row["near"].item() for row in rows] == [time - 5 for time in times]
    assert [row["held"].item() for row in rows] == [
        max(s for s in whole if s <= time) for time in times
    ]


def test_messages_out_of_order_are_sorted_and_the_last_one_of_a_stamp_counts(
    tmp_path: Path,
) -> None:
    messages = [(0, {"x": 1}), (200, {"x": 3}), (100, {"x": 9}), (100, {"x": 2})]
    path = write(tmp_path / "a.mcap", {"/a": messages})
    assert [row["f"].item() for row in read_frames(path, load(tmp_path, {"f": feature()}))] == [
        1,
        2,
        3,
    ]


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (4, 6, 3), np.uint8)


def raw(number: int, encoding: str = "rgb8") -> RawImage:
    pixels = picture(number) if encoding == "rgb8" else picture(number)[:, :, ::-1]
    padded = np.pad(pixels.reshape(4, 18), ((0, 0), (0, 2)))  # rows may be longer than their pixels
    return RawImage(width=6, height=4, step=20, encoding=encoding, data=padded.tobytes())


def png(number: int) -> CompressedImage:
    return CompressedImage(format="png", data=encoded(picture(number)))


def test_pictures_come_in_pixel_for_pixel(tmp_path: Path) -> None:
    kinds: dict[str, Any] = {"raw": raw, "bgr": lambda n: raw(n, "bgr8"), "png": png}
    stamps = (0, 100, 100, 200)  # of equal ones the last one counts
    topics = {
        f"/{name}": [(stamp, make(n)) for n, stamp in enumerate(stamps)]
        for name, make in kinds.items()
    }
    camera = {"resample": "nearest", "tolerance": 0.02, "video": False}
    mapping = load(tmp_path, {name: {**camera, "topic": f"/{name}"} for name in kinds})
    rows = list(read_frames(write(tmp_path / "a.mcap", topics), mapping))
    for row, number in zip(rows, (0, 2, 3), strict=True):
        for name in kinds:
            np.testing.assert_array_equal(row[name], picture(number))


stamp_lists = st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True).map(sorted)


@settings(max_examples=300)
@given(st.sampled_from(["nearest", "previous"]), stamp_lists, stamp_lists, st.integers(0, 20))
def test_every_frame_gets_what_a_full_search_finds(
    method: Any, stamps, later, tolerance: int
) -> None:
    times = [stamps[0] + time for time in later]
    near = [min(stamps, key=lambda stamp: (abs(stamp - time), stamp)) for time in times]
    before = [max(stamp for stamp in stamps if stamp <= time) for time in times]
    wanted = near if method == "nearest" else before
    gaps = [frame for frame, time in enumerate(times) if abs(wanted[frame] - time) > tolerance]
    source, second = TopicSource("/t", method, tolerance, "x", "float32"), 10**9
    arrays = np.array(stamps) * second, np.array(times) * second
    if gaps:
        place = f"a gap at {times[gaps[0]] - times[0]} s"
        with pytest.raises(
            ManipError, match=rf"f, topic /t: {place} .*frame {gaps[0]}\); {method} allows"
        ):
            pick("f, topic /t", source, *arrays)
    else:
        assert [stamps[number] for number in pick("f", source, *arrays)] == wanted


@pytest.mark.slow
@pytest.mark.parametrize(
    ("damage", "why"),
    [
        (False, r"shape of 'f' differs: .*b\.mcap has \(3,\), .*a\.mcap has \(2,\)"),
        (True, r"cannot read .*b\.mcap: ."),
    ],
)
def test_a_file_that_is_cut_or_does_not_fit_the_first_one_leaves_nothing(
    tmp_path, damage: bool, why: str
) -> None:
    first = write(tmp_path / "a.mcap", {"/a": [(0, {"x": [1, 2]})]})
    second = write(tmp_path / "b.mcap", {"/a": [(0, {"x": [1, 2, 3]})]})
    if damage:
        second.write_bytes(first.read_bytes()[:-20])
    with pytest.raises(ManipError, match=why):
        import_files([first, second], tmp_path / "new", load(tmp_path, {"f": feature()}))
    assert sorted(path.name for path in tmp_path.iterdir()) == ["a.mcap", "b.mcap", "m.yaml"]


def test_a_stamp_that_numpy_cannot_hold_and_text_that_no_file_can_are_refused_in_a_line(
    tmp_path: Path,
) -> None:
    mapping = load(tmp_path, {"f": feature()})
    path = write(tmp_path / "a.mcap", {"/a": [(0, {"x": 1}), (2**63 // 10**6 + 1, {"x": 2})]})
    with pytest.raises(
        ManipError, match=r"a\.mcap: the log time of /a is 9223372036855000000; expected"
    ):
        list(read_frames(path, mapping))
    path = write(tmp_path / "b.mcap", {"/a": [(0, {"x": "\ud800"})]})
    with pytest.raises(ManipError, match=r"b\.mcap.*in Unicode"):
        list(read_frames(path, load(tmp_path, {"f": feature(dtype="string")})))
