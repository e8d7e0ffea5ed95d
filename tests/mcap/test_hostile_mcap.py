"""What an MCAP file may unpack to is bounded, whatever it declares; nothing is allocated on its word."""

from __future__ import annotations

import json
import subprocess
import sys
import tracemalloc
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from foxglove_schemas_protobuf.RawImage_pb2 import RawImage
from mcap.records import Attachment, McapRecord, Metadata

from manip_il.collect.record import _read_or_set_aside
from manip_il.data import journal, mcap_records
from manip_il.data import schema as s
from manip_il.data.foxglove import IMAGE_TOPICS
from manip_il.data.mcap_records import LARGEST_CHUNK, LARGEST_NOTE
from manip_il.doctor.leftovers import count_readable
from manip_il.errors import ManipError
from manip_il.mcap import read as mcap_read
from manip_il.mcap.importing import read_import
from manip_il.mcap.mapping import Mapping
from manip_il.mdp import Episode

from ..pictures import numbered_episodes, with_cameras
from ..synthetic import MakeEpisode
from . import mcap_forgery as forge
from .use import imported, load

MIB = 1024 * 1024
BOMB = LARGEST_CHUNK + 32 * MIB


@contextmanager
def at_most(limit: int) -> Iterator[None]:
    """Limit the memory that reading may take [MiB]."""
    tracemalloc.start()
    try:
        yield
        peak = tracemalloc.get_traced_memory()[1]
    finally:
        tracemalloc.stop()
    assert peak < limit * MIB, f"{peak / MIB:.0f} MiB"


SMALL = with_cameras(s.RobotTaskSpec("r", "t", 20, ("a",), ("x",), 1, ""), "front")


def about(frames: int = 2, **changes: str) -> Metadata:
    said = {"format": "2", "seed": "1", "success": "true", "success_at_end": "true", "frames": str(frames)}
    return forge.note(said | {"spec": json.dumps(SMALL.to_json()), "fingerprint": "{}"} | changes)


def action(data: bytes = forge.npy(np.zeros((2, 1), np.float32))) -> Attachment:
    return forge.column(s.ACTION, data)


def forged(tmp_path: Path, *records: McapRecord | bytes, **how: Any) -> Path:
    return forge.write_mcap(journal.episode_path(tmp_path / "d.journals", 1), *records, **how)


def refuse(path: Path, words: str, read: Callable[[Path], object] = journal.read_journal, most: int = 10) -> None:
    with at_most(most), pytest.raises(ManipError) as error:
        read(path)
    assert words in str(error.value)
    assert path.name in str(error.value)
    assert len(str(error.value)) < 600


def filmed(count: int, height: int = 72, camera: str = "front") -> McapRecord:
    width = SMALL.image_size[1]
    picture = RawImage(height=height, width=width, data=bytes(height * width * 3)).SerializeToString()
    return forge.messages_chunk([forge.message(picture)] * count, forge.json_channel(IMAGE_TOPICS + camera))


def test_a_forged_journal_that_keeps_to_the_rules_is_read(tmp_path: Path) -> None:
    header, episode = journal.read_journal(forged(tmp_path, about(), action(), filmed(2)))
    assert header.spec == SMALL
    assert episode.columns["observation.images.front"].shape == (2, *SMALL.image_size, 3)
    assert episode.columns[s.ACTION].flags.writeable
    assert list(journal.read_episode(forged(tmp_path, about(), action())).columns) == [s.ACTION]


_LYING_FRAME = bytes.fromhex("28b52ffda0") + (100 * MIB).to_bytes(4, "little") + bytes.fromhex("010000")


def bomb(compression: str, declares: int, in_frame: bool) -> McapRecord:
    return forge.chunk(compression, forge.zeros(compression, BOMB, declared=in_frame), declares)


REFUSED: list[tuple[Callable[[], Sequence[McapRecord | bytes]], str]] = [
    *(
        (partial(lambda *how: [about(), action(), bomb(*how)], compression, declares, in_frame), words)
        for compression in ("zstd", "lz4")
        for declares, in_frame, words in (
            (BOMB, True, "expected at most 134,217,728"),
            (MIB, True, "a chunk"),  # the two declarations differ
            (MIB, False, "a chunk"),  # and here it is longer than the one there is
            (2**63, True, "expected at most"),
        )
    ),
    *(
        (partial(lambda *said: [about(), action(forge.npy_header(*said) + bytes(64))], descr, shape), words)
        for descr, shape, words in (
            ("'<f8'", "(1000000, 1000000)", "declares shape (1000000, 1000000) of float64 and has 64 bytes"),
            ("'<f8'", "(7,)", "declares shape (7,)"),
            ("'<f8'", "(-8,)", "declares shape"),
            ("'<U0'", "(1000000000000,)", "expected numbers"),
            ("'|O'", "(8,)", "expected numbers"),
            ("'<f8'", "'x'", "shape"),
            ("['" + "x" * 100 + "']", "(1,)", "not a complete episode"),
        )
    ),
    (lambda: [about(s.MOST_FRAMES), action(), filmed(1)], "it unpacks to more than 671,088,640 bytes"),
    *(
        (partial(lambda *film: [about(), action(), filmed(*film)], *film), words)
        for *film, words in (
            (1, 72, "front", "it holds 1 pictures of front; expected 2"),
            (3, 72, "front", "picture 2 of front, 72 x 96, is not one of 2"),
            (2, 5, "front", "5 x 96, is not one of"),
            (2, 72, "wrist", "it holds pictures of 'wrist'; its header names ('front',)"),
            (2, 72, "x/../../y", "it holds pictures of 'x/../../y'"),
        )
    ),
    *(
        (partial(lambda record: [about(), action(), filmed(2), record], record), words)
        for record, words in (
            (forge.chunk("zstd", _LYING_FRAME, MIB), "declares 1,048,576 bytes, its zstd frame 104,857,600"),
            (forge.framed(0x0C, bytes(LARGEST_NOTE + 1)), "a metadata record has 1,048,577 bytes; expected at most"),
            (forge.framed(0x09, bytes(10), 2**62), "it ends too early"),
            (forge.framed(0x09, bytes(16 + 8) + b"\xff" * 20), "whose sizes do not fit its record"),
            (forge.framed(0x09, bytes(16) + b"\xff" * 20), "can't decode"),
            (forge.chunk("zip", b"", 0), "compressed by 'zip'; expected zstd, lz4 or none"),
            (forge.chunk("", forge.filler(100), 109), "a chunk unpacks to 9 bytes or more; it declares 109"),
            (forge.chunk("", forge.filler(100), 9), "a chunk ends too early"),
            (forge.chunk("", b"abc", 3), "a chunk ends too early"),
            (forge.chunk("", forge.framed(5, b"x"), 10), "a message record ends too early"),
            (forge.chunk("zstd", b"\x28\xb5\x2f\xfdx", 3), "cannot be unpacked"),
            (forge.chunk("lz4", b"nothing", 3), "cannot be unpacked"),
        )
    ),
    *(
        (partial(lambda changes: [about(**changes), action()], changes), words)
        for changes, words in (
            ({"frames": "0"}, "its number of frames is 0"),
            ({"frames": "3"}, "its header counts 3 frames, its columns 2"),
            ({"frames": "1" * 5_000}, "its frames is not valid JSON"),
            ({"seed": "-5"}, "its seed is -5"),
            ({"seed": '"1"'}, "its seed is '1'"),
            ({"success": "1"}, "its success is 1; expected true or false"),
            ({"spec": "[" * 100_000}, "nested too deeply"),
            ({"fingerprint": "null"}, "its fingerprint is None"),
            ({"format": "9"}, "its format is '9'"),
        )
    ),
]


@pytest.mark.parametrize(("records", "words"), REFUSED, ids=[words for _, words in REFUSED])
def test_a_journal_that_lies_is_refused_and_takes_little_memory(
    tmp_path: Path, records: Callable[[], Sequence[McapRecord | bytes]], words: str
) -> None:
    path = forged(tmp_path, *records())
    assert path.stat().st_size < 3 * MIB
    refuse(path, words)


def test_a_bomb_is_unpacked_for_no_header_and_set_aside_by_a_resumed_recording(tmp_path: Path) -> None:
    record = forge.raw(bomb("zstd", BOMB, True))
    path = forged(tmp_path, about(), action(), record, summary=record)
    with at_most(10):
        assert journal.read_header(path).spec == SMALL
        assert journal.read_header(path, check_sums=True).spec == SMALL
        assert count_readable(path.parent) == 1  # which the doctor asks
        assert _read_or_set_aside(path) is None
    assert journal.list_episodes(path.parent) == []


@pytest.mark.slow
def test_thousands_of_frames_of_two_cameras_are_read(tmp_path: Path) -> None:
    spec = s.RobotTaskSpec("r", "t", 20, ("a",), ("x",), 1, "", cameras=("front", "wrist"), image_size=(128, 128))
    frames = 2_000
    level = np.zeros((frames, 128, 128, 3), np.uint8)
    level[:, :, :64] = np.random.default_rng(0).integers(0, 255, (frames, 1, 64, 3), np.uint8)
    columns = {s.ACTION: np.zeros((frames, 1), np.float32)} | {s.IMAGES + name: level for name in spec.cameras}
    path = journal.write_episode(tmp_path, Episode(1, columns, True, True), spec, {})
    found = journal.read_episode(path)
    assert (found.columns[s.IMAGES + "wrist"] == level).all()


# ---- import


def mapping_of(tmp_path: Path, key: str, **how: Any) -> Mapping:
    return load(tmp_path, {key: how | {"topic": "/a", "resample": "nearest", "tolerance": 1e9}})


@pytest.fixture
def mapping(tmp_path: Path) -> Mapping:
    return mapping_of(tmp_path, "x", field="x", dtype="float64")


@pytest.fixture
def seeing(tmp_path: Path) -> Mapping:
    return mapping_of(tmp_path, "observation.images.a", video=False)


@pytest.mark.parametrize("compression", ["zstd", "lz4", ""])
def test_messages_of_every_compression_and_of_none_are_imported(
    tmp_path: Path, mapping: Mapping, compression: str
) -> None:
    loose = [forge.message(b'{"x": 1}', stamp) for stamp in (0, 100_000_000)]
    stream = forge.messages_chunk(loose, forge.json_channel(), compression=compression)
    plain = forge.messages_chunk(loose, forge.json_channel(), compression="").data
    packer = forge.zstandard.ZstdCompressor().compressobj()  # a frame that does not say how long it is
    open_ended = forge.chunk("zstd", packer.compress(plain) + packer.flush(), len(plain))
    for records in ([stream], [forge.json_channel(), *loose], [open_ended]):
        assert read_import(forge.write_mcap(tmp_path / "a.mcap", *records), mapping).frames == 2


def said(*contents: bytes, step: int = 100_000_000) -> list[McapRecord | bytes]:
    messages = [forge.message(content, number * step) for number, content in enumerate(contents)]
    return [forge.messages_chunk(messages, forge.json_channel())]


def schemas(size: int, numbers: Iterable[int]) -> list[McapRecord | bytes]:
    return [forge.messages_chunk([], forge.schema("x", bytes(size), number)) for number in numbers]


@pytest.mark.parametrize(
    ("records", "most", "words", "limits"),
    [
        (lambda: [bomb("lz4", MIB, False)], 10, "a chunk", {}),
        (
            *(lambda: schemas(MIB // 2, [1] * 3), 10, "it unpacks to more than 1,048,576 bytes"),
            {"LARGEST_FILE": MIB, "_LARGEST_RATIO": 1},
        ),
        (  # a list of empty lists takes twenty times its text
            *(lambda: said(b'{"x": [' + b"[]," * 3_000_000 + b"[]]}"), 60),
            *("a message of 9,000,011 bytes; expected at most 8,388,608", {}),
        ),
        (lambda: said(*[b'{"x": 1}'] * 3), 10, "it unpacks to more than 2 bytes", {"LARGEST_DECODED": 2}),
        (lambda: said(*[b'{"x": 1}'] * 3), 10, "its values take more than 0 MiB", {"LARGEST_ROWS": 2}),
        *(
            (partial(said, content, content), 10, "/a", {})
            for content in (b'{"x": {"y": 1}}', b'{"x": [[1], [2]]}', b'{"x": null}', b'{"x": [{}]}')
        ),
        (
            *(lambda: said(b'{"x": 1}', b'{"x": 2}', step=2**62), 10),
            *("more than 1,000,000 frames; expected one episode a file", {}),
        ),
        (lambda: schemas(MIB - 100, range(1, 60)), 40, "its schemas and channels together", {}),
        (lambda: [forge.message(b"{}", channel=7)], 10, "a message of channel 7, which it does not define", {}),
        (
            *(lambda: [forge.json_channel(schema=5), forge.message(b"{}")], 10),
            *("has schema 5, which it does not define", {}),
        ),
    ],
)
def test_an_import_is_refused_and_takes_little_memory(
    tmp_path: Path,
    mapping: Mapping,
    monkeypatch: pytest.MonkeyPatch,
    records: Callable[[], Sequence[McapRecord | bytes]],
    most: int,
    words: str,
    limits: dict[str, int],
) -> None:
    for name, value in limits.items():
        monkeypatch.setattr(mcap_read, name, value)
    path = forge.write_mcap(tmp_path / "a.mcap", *records())
    assert path.stat().st_size < MIB
    refuse(path, words, lambda path: imported(path, mapping), most)


def test_a_schema_that_a_writer_repeats_counts_once(tmp_path: Path, mapping: Mapping) -> None:
    path = forge.write_mcap(tmp_path / "a.mcap", *schemas(MIB - 100, [1] * 60), *said(b'{"x": 1}'))
    assert read_import(path, mapping).frames == 1


def test_an_attachment_is_never_held(tmp_path: Path, mapping: Mapping) -> None:
    large = forge.column("x", bytes(50 * MIB))
    path = forge.write_mcap(tmp_path / "a.mcap", large, *said(b'{"x": 1}'))
    del large
    with at_most(10):
        assert read_import(path, mapping).frames == 1


def image_file(tmp_path: Path, name: str, descriptor: bytes, *contents: bytes) -> Path:
    channel = forge.Channel(id=1, topic="/a", message_encoding="protobuf", metadata={}, schema_id=1)
    messages = [forge.message(content, number * 100_000_000) for number, content in enumerate(contents)]
    return forge.write_mcap(
        tmp_path / "a.mcap", forge.messages_chunk(messages, forge.schema(name, descriptor), channel)
    )


def test_a_picture_is_decoded_by_our_schema_and_not_by_the_files(tmp_path: Path, seeing: Mapping) -> None:
    message = RawImage(height=1, width=2, encoding="rgb8", step=6, data=bytes(6)).SerializeToString()
    path = image_file(tmp_path, "foxglove.RawImage", b"no descriptor", message, message)
    assert imported(path, seeing)[0]["observation.images.a"].shape == (1, 2, 3)


def test_pictures_count_as_what_they_are_decoded_to(
    tmp_path: Path, seeing: Mapping, monkeypatch: pytest.MonkeyPatch
) -> None:
    message = RawImage(height=500, width=1000, encoding="rgb8", step=3000, data=bytes(1_500_000)).SerializeToString()
    path = image_file(tmp_path, "foxglove.RawImage", b"", message, message)
    monkeypatch.setattr(mcap_read, "_LARGEST_RATIO", 1)
    monkeypatch.setattr(mcap_read, "LARGEST_FILE", 3_100_000)
    assert len(imported(path, seeing)) == 2
    monkeypatch.setattr(mcap_read, "LARGEST_FILE", 1_400_000)
    refuse(path, "it unpacks to more than 1,400,000 bytes", lambda path: imported(path, seeing))


_MEASURED = """
import sys
from pathlib import Path
from manip_il.cli.main import main
code = main(sys.argv[1:])
status = Path("/proc/self/status").read_text()  # the most that this process held, not the one that started it
print(code, int(status.partition("VmHWM:")[2].split()[0]) // 1024, file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize("command", ["build", "doctor", "import"])
def test_a_bomb_takes_less_than_a_gigabyte(tmp_path: Path, mapping: Mapping, command: str) -> None:
    """Nine gigabytes in a file of less than half a megabyte."""
    size = LARGEST_CHUNK // MIB * MIB
    one = forge.zstandard.compress(forge.filler(size))
    bombs = [forge.chunk("zstd", one, size)] * 72
    journals, dataset = tmp_path / "d.journals", tmp_path / "d"
    if command == "import":
        path = forge.write_mcap(tmp_path / "a.mcap", *bombs)
        words = ["mcap", "import", str(path), str(dataset), f"--mapping={tmp_path / 'm.yaml'}"]
    else:
        path = forged(tmp_path, about(), action(), *bombs)
        words = [command, *([str(journals)] if command == "build" else []), str(dataset)]
        if command == "doctor":
            dataset.mkdir()
            words.append("--repair=true")
    assert path.stat().st_size < 2 * MIB
    done = subprocess.run([sys.executable, "-c", _MEASURED, *words], capture_output=True, text=True, check=True)
    *said, last = done.stderr.strip().splitlines()
    code, peak = map(int, last.split())
    assert code == 1
    assert sum(line.startswith("manip-il: error: ") for line in said) == 1, done.stderr
    assert len(said) <= 2  # and how far it had come
    assert peak < 1024, f"{peak} MiB"


@pytest.mark.parametrize(
    ("name", "value", "words"),
    [
        ("LARGEST_EPISODE", 1_000, r"it unpacks to more than [\d,]+ bytes"),
        ("_MOST_COLUMNS", 3, "it holds more than 3 columns"),
        ("MOST_FRAMES", 8, "its number of frames is 9; expected a whole number from 1 to 8"),
        ("LARGEST_CHUNK", 100, "a chunk, unpacked, has [0-9,]+ bytes; expected at most 100"),
        ("MOST_RECORDS", 5, "it holds more than 5 messages"),
    ],
)
def test_what_could_not_be_read_is_not_written(
    tmp_path: Path,
    make_episode: MakeEpisode,
    spec: s.RobotTaskSpec,
    monkeypatch: pytest.MonkeyPatch,
    name: str,
    value: int,
    words: str,
) -> None:
    module, episode = journal if hasattr(journal, name) else s, make_episode(7)
    if hasattr(mcap_records, name):  # limits of messages, which only pictures are read from
        module, spec = mcap_records, with_cameras(spec, "front")
        episode = numbered_episodes(make_episode, spec)[0]
    monkeypatch.setattr(journal, "_LARGEST_RATIO", 0)
    journal.write_episode(tmp_path / "within", episode, spec, {})
    monkeypatch.setattr(module, name, value)
    why = f"the journal of the episode with seed {episode.seed} could not be read: {words}; record "
    with pytest.raises(ManipError, match=f"^{why}"):
        journal.write_episode(tmp_path / "beyond", episode, spec, {})
    assert not (tmp_path / "beyond").exists()


def test_a_fingerprint_that_could_not_be_read_is_not_written(make_episode: MakeEpisode, spec: s.RobotTaskSpec) -> None:
    with pytest.raises(ManipError, match=r"a metadata record has [\d,]+ bytes; expected at most 1,048,576"):
        journal.encode_episode(make_episode(7), spec, {"text": "x" * 2**20})
