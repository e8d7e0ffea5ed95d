"""MCAP to episodes: every value from a message that the mapping allows, or an error that says where and when.

Resampling is compared with a search through all messages.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Iterable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.CompressedImage_pb2 import CompressedImage
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from hypothesis import assume, given, settings
from hypothesis import strategies as st
from mcap.writer import Writer
from mcap_protobuf.schema import register_schema

from manip_il.data.foxglove import NANOSECONDS
from manip_il.data.journal import write_episode
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, SUCCESS, RobotTaskSpec
from manip_il.errors import ManipError, MismatchError
from manip_il.mcap.importing import features_of, frame_times, frames_of, list_files, pick, read_import
from manip_il.mcap.mapping import Method

from ..damage import digests
from ..pictures import encoded
from ..synthetic import MakeEpisode
from .use import imported, load

MS = 1_000_000
JSON = "json"
Messages = Iterable[tuple[int, Any]]  # stamp [ms], content


def write(path: Path, topics: dict[str, Messages], encoding: str = JSON) -> Path:
    """Topics of JSON or protobuf messages, in the order of their stamps."""
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        for topic, messages in topics.items():
            channel = None
            for stamp, content in messages:
                is_json = isinstance(content, dict)
                if channel is None:
                    schema = 0 if is_json else register_schema(writer, type(content))
                    channel = writer.register_channel(topic, encoding if is_json else "protobuf", schema)
                data = json.dumps(content).encode() if is_json else content.SerializeToString()
                writer.add_message(channel, stamp * MS, data, stamp * MS)
        writer.finish()
    return path


def feature(topic: str = "/a", **changes: Any) -> dict[str, Any]:
    return {"topic": topic, "field": "x", "dtype": "float64", "resample": "nearest", "tolerance": 0.02, **changes}


def ramp(stamps: Iterable[int]) -> list[tuple[int, Any]]:
    return [(stamp, {"x": float(stamp)}) for stamp in stamps]


def test_topics_of_other_rates_meet_on_the_datasets_clock(tmp_path: Path) -> None:
    fast, slow, whole = range(0, 1001, 10), range(45, 900, 50), range(5, 990, 7)
    topics = {"/fast": ramp(fast), "/slow": ramp(slow), "/whole": [(s, {"x": s}) for s in whole], "/rest": ramp([0])}
    path = write(tmp_path / "a.mcap", topics)
    mapping = load(
        tmp_path,
        {
            "near": feature("/fast"),
            "between": feature("/slow", resample="interpolate", tolerance=0.05),
            "held": feature("/whole", resample="hold", dtype="int64"),
        },
    )
    episode, rows = read_import(path, mapping), imported(path, mapping)
    times = list(range(45, 896, 100))  # from the latest first message to the earliest last one
    assert episode.frames == len(rows) == len(times)
    assert [row["between"].item() for row in rows] == times
    assert all(abs(row["near"].item() - time) <= 5 for row, time in zip(rows, times, strict=True))
    assert [row["held"].item() for row in rows] == [max(s for s in whole if s <= time) for time in times]
    assert {row["task"] for row in rows} == {"t"}
    assert episode.counts == {"/fast": 101, "/slow": 18, "/whole": 141, "/rest": 1}
    assert episode.used == {"/fast": 9, "/slow": 9, "/whole": 9}


def test_numbers_keep_every_bit_and_texts_every_letter(tmp_path: Path) -> None:
    big, small = 2**63 - 1, 5e-324
    contents = [{"i": big - n, "f": [small * n, -0.0], "b": n == 1, "s": f"é\n{n}"} for n in range(3)]
    path = write(tmp_path / "a.mcap", {"/a": [(n * 100, content) for n, content in enumerate(contents)]})
    mapping = load(
        tmp_path,
        {
            "i": feature(field="i", dtype="int64"),
            "f": feature(field=["f[:]", "f[0]"], shape=[3, 1], names=None),
            "b": feature(field="b", dtype="bool"),
            "s": feature(field="s", dtype="string"),
        },
        task={"topic": "/a", "field": "s", "resample": "hold", "tolerance": 0},
    )
    rows = imported(path, mapping)
    for n, row in enumerate(rows):
        assert (row["i"].item(), row["b"].item(), row["s"], row["task"]) == (big - n, n == 1, f"é\n{n}", f"é\n{n}")
        assert row["f"].tobytes() == np.array([small * n, -0.0, small * n]).tobytes()
        assert row["f"].shape == (3, 1)


def picture(number: int) -> np.ndarray:
    return np.random.default_rng(number).integers(0, 256, (4, 6, 3), np.uint8)


def raw(number: int, encoding: str = "rgb8") -> RawImage:
    pixels = picture(number) if encoding == "rgb8" else picture(number)[:, :, ::-1]
    padded = np.pad(pixels.reshape(4, 18), ((0, 0), (0, 2)))  # rows may be longer than their pixels
    return RawImage(width=6, height=4, step=20, encoding=encoding, data=padded.tobytes())


def png(number: int) -> CompressedImage:
    return CompressedImage(format="png", data=encoded(picture(number)))


def test_pictures_are_the_nearest_ones_pixel_for_pixel(tmp_path: Path) -> None:
    stamps = range(0, 500, 33)
    topics = {
        "/a": ramp(range(0, 500, 100)),
        "/raw": [(stamp, raw(n)) for n, stamp in enumerate(stamps)],
        "/bgr": [(stamp, raw(n, "bgr8")) for n, stamp in enumerate(stamps)],
        "/png": [(stamp, png(n)) for n, stamp in enumerate(stamps)],
    }
    path = write(tmp_path / "a.mcap", topics)
    camera = {"resample": "nearest", "tolerance": 0.02, "video": False}
    mapping = load(
        tmp_path, {"a": feature(), **{name: {**camera, "topic": f"/{name}"} for name in ("raw", "bgr", "png")}}
    )
    episode, rows = read_import(path, mapping), imported(path, mapping)
    for time, row in zip(range(0, 500, 100), rows, strict=True):
        wanted = picture(min(range(len(stamps)), key=lambda n: abs(stamps[n] - time)))
        for name in ("raw", "bgr", "png"):
            np.testing.assert_array_equal(row[name], wanted)
    names = ["height", "width", "channels"]
    assert features_of(mapping, episode)["raw"] == {"dtype": "image", "shape": (4, 6, 3), "names": names}


STEADY = range(0, 1000, 100)


@pytest.mark.parametrize(
    ("messages", "changes", "why"),
    [
        (ramp([0, 100, 400, 500]), {}, r"topic /a: a gap at 0\.2 s .*0\.1 s before and 0\.2"),
        (ramp([0, 200, 100]), {}, r"topic /a: message 2 is stamped 100000000 ns, the one before it 200000000 ns"),
        (ramp([0, 100, 100]), {}, "expected ascending log times"),
        ([(0, {"x": "1"})], {}, "message 0 holds '1'; expected a number"),
        ([(0, {"x": None})], {}, "message 0 holds None; expected a number"),
        ([(0, {"x": 1}), (100, {"x": float("nan")})], {}, "message 1 holds nan, which is not a valid float64"),
        ([(0, {"x": 1e39})], {"dtype": "float32"}, r"message 0 holds 1e\+39, which is not a valid float32"),
        ([(0, {"x": 1.5})], {"dtype": "int64"}, "holds 1.5, which is not a valid int64"),
        ([(0, {"x": 300})], {"dtype": "uint8"}, "holds 300, which is not a valid uint8"),
        ([(0, {"x": float("inf")})], {"dtype": "int64"}, "holds inf, which is not a valid int64"),
        ([(0, {"x": 2})], {"dtype": "bool"}, "holds 2, which is not a valid bool"),
        ([(0, {"x": 2})], {"dtype": "string"}, r"got \[2\]; expected one string"),
        ([(0, {"x": [1, 2]})], {"names": ["a"]}, "topic /a at 0 ns: 2 values, f has 1"),
        ([(0, {"x": [1, 2]}), (100, {"x": [1]})], {}, "message 1 has 1 values, the first one 2"),
        ([(0, {"x": 1}), (100, {"y": 1})], {}, "topic /a at 100000000 ns: x: no field 'x'"),
        (ramp(STEADY), {"topic": "/b"}, "has no messages of /b .*its topics: /a, /late, /steady"),
        (ramp(STEADY), {"topic": "/late"}, r"/steady ends 4\.1 s before /late starts"),
    ],
)
def test_what_cannot_be_is_refused_by_file_topic_and_time(
    tmp_path: Path, messages: Messages, changes: dict[str, Any], why: str
) -> None:
    topics = {"/a": messages, "/steady": ramp(STEADY), "/late": ramp([5000, 5100])}
    path = write(tmp_path / "bad.mcap", topics)
    with pytest.raises(ManipError, match=rf"bad\.mcap.*{why}"):
        read_import(path, load(tmp_path, {"f": feature(**changes), "g": feature("/steady")}))


def test_an_encoding_that_cannot_be_read_is_refused(tmp_path: Path) -> None:
    path = write(tmp_path / "ros.mcap", {"/a": ramp(STEADY)}, "cdr")
    with pytest.raises(ManipError, match=r"ros\.mcap, topic /a: its messages are encoded as 'cdr'; expected protobuf"):
        read_import(path, load(tmp_path, {"f": feature()}))


@pytest.mark.parametrize("keep", [0, 5, 0.3, 0.9, 0.99])
def test_a_file_that_is_cut_is_refused(tmp_path: Path, keep: float) -> None:
    path = write(tmp_path / "cut.mcap", {"/a": ramp(range(1000))})
    data = path.read_bytes()
    path.write_bytes(data[: keep if isinstance(keep, int) else int(len(data) * keep)])
    with pytest.raises(ManipError, match=r"cannot read .*cut\.mcap: .*; expected a complete MCAP file"):
        read_import(path, load(tmp_path, {"f": feature()}))


@pytest.mark.parametrize(
    ("message", "why"),
    [
        (raw(0, "mono8"), "encoded as 'mono8'; expected rgb8 or bgr8"),
        (RawImage(width=6, height=4, encoding="rgb8", data=b"12"), "a picture of 4 x 6 with 2 bytes, 18 a row"),
        (CompressedImage(format="png", data=b"no"), "a picture that cannot be decoded"),
        ({"x": 1}, "a message of no schema; pictures are read from foxglove.RawImage"),
    ],
)
def test_what_is_no_picture_is_refused(tmp_path: Path, message: Any, why: str) -> None:
    path = write(tmp_path / "p.mcap", {"/a": [(0, message)]})
    mapping = load(tmp_path, {"c": {"topic": "/a", "video": False, "resample": "nearest", "tolerance": 0.1}})
    with pytest.raises(ManipError, match=rf"p\.mcap, topic /a at 0 ns: .*{why}"):
        imported(path, mapping)


def test_files_that_do_not_fit_each_other_are_refused(tmp_path: Path) -> None:
    mapping = load(tmp_path, {"f": feature()})
    first = write(tmp_path / "a.mcap", {"/a": [(0, {"x": [1, 2]})]})
    second = write(tmp_path / "b.mcap", {"/a": [(0, {"x": [1, 2, 3]})]})
    features = features_of(mapping, read_import(first, mapping))
    with pytest.raises(MismatchError, match=r"column 'f' differs: .*b\.mcap has 3, the first file has 2 values"):
        list(frames_of(read_import(second, mapping), mapping, features))


def test_our_journals_come_in_by_a_mapping_of_their_topics(
    tmp_path: Path, make_episode: MakeEpisode, spec: RobotTaskSpec
) -> None:
    episode = make_episode(3, 6)
    path = write_episode(tmp_path, episode, spec, {})
    joints = [f"joints[name={name}].position" for name in spec.joint_names]
    places = [f"transforms[child_frame_id=ee].translation.{axis}" for axis in "xyz"]
    mapping = load(
        tmp_path,
        {
            STATE: feature("/joint_states", field=joints, dtype="float32", names=list(spec.joint_names)),
            ACTION: feature("/action", field="joints[:].position", dtype="float32", resample="hold"),
            "place": feature("/tf", field=places, resample="interpolate", tolerance=0.1),
            SUCCESS: feature("/scalars", field="scalars[label=next.success].value", dtype="bool"),
        },
        fps=spec.fps,
    )
    found = read_import(path, mapping).columns
    for key in (STATE, ACTION, SUCCESS):
        np.testing.assert_array_equal(found[key], episode.columns[key])
    np.testing.assert_array_equal(found["place"], episode.columns[ENVIRONMENT_STATE][:, :3])


def test_files_are_taken_in_the_order_of_their_names(tmp_path: Path) -> None:
    for name in ("b.mcap", "a.mcap", ".c.mcap", "d.txt"):
        (tmp_path / name).touch()
    assert [path.name for path in list_files(tmp_path)] == ["a.mcap", "b.mcap"]
    assert list_files(tmp_path / "b.mcap") == [tmp_path / "b.mcap"]
    with pytest.raises(ManipError, match="no such file or folder"):
        list_files(tmp_path / "x")
    (tmp_path / "empty").mkdir()
    with pytest.raises(ManipError, match=r"holds no \*\.mcap files"):
        list_files(tmp_path / "empty")


SECOND = NANOSECONDS
stamp_lists = st.lists(st.integers(0, 40), min_size=1, max_size=12, unique=True).map(sorted)


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
@given(st.sampled_from(["nearest", "hold", "interpolate"]), stamp_lists, stamp_lists, st.integers(0, 20))
def test_every_frame_gets_what_a_full_search_finds(
    method: Method, stamps: list[int], times: list[int], tolerance: int
) -> None:
    wanted = [expected(method, stamps, time, tolerance) for time in times]
    arrays = np.array(stamps) * SECOND, np.array(times) * SECOND
    if None in wanted:
        frame = wanted.index(None)
        why = rf"f\.mcap, topic /t: a gap at {times[frame] - times[0]} s .*frame {frame}\)"
        with pytest.raises(ManipError, match=why):
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


@given(stamp_lists, stamp_lists, st.floats(-10, 10), st.floats(-10, 10))
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


IMPORT = """
import sys
from pathlib import Path
from manip_il.data.lerobot_library import join_datasets
from manip_il.mcap.importing import import_files
from manip_il.mcap.mapping import load_mapping
source, target = map(Path, sys.argv[1:])
list(import_files([source / "a.mcap"] * 2, target / "new", load_mapping(source / "m.yaml")))
join_datasets([target / "new"] * 2, target / "joined", "a/b")
"""


@pytest.mark.slow
@pytest.mark.parametrize("video", [False, True])
def test_two_imports_and_joins_of_the_same_files_give_the_same_bytes(tmp_path: Path, video: bool) -> None:
    big = np.zeros((64, 64, 3), np.uint8)
    pictures = [(stamp, CompressedImage(format="png", data=encoded(big + stamp // 10))) for stamp in STEADY]
    write(tmp_path / "a.mcap", {"/a": ramp(STEADY), "/b": ramp(STEADY), "/c": pictures})
    camera = {"topic": "/c", "resample": "nearest", "tolerance": 0.02, "video": video}
    load(tmp_path, {"observation.state": feature(), "action": feature("/b"), "observation.images.c": camera})
    for seed in ("1", "2"):  # of the order of sets
        command = [sys.executable, "-c", IMPORT, str(tmp_path), str(tmp_path / seed)]
        subprocess.run(command, check=True, env={**os.environ, "PYTHONHASHSEED": seed})
    assert (tmp_path / "1" / "joined" / "meta").is_dir()
    assert digests(tmp_path / "1") == digests(tmp_path / "2")
