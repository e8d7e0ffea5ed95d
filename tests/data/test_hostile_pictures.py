"""Pictures and videos from outside open no other file or program, and do not fill the memory."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from contextlib import closing
from fractions import Fraction
from pathlib import Path
from typing import cast

import av
import numpy as np
import pytest
from av.video.codeccontext import VideoCodecContext
from PIL import Image

from manip_il.data import pictures
from manip_il.data import schema as s
from manip_il.data.frame_source import ParquetPart
from manip_il.data.pictures import VideoReader, count_packets, decode_picture, open_picture, open_video
from manip_il.doctor import cameras
from manip_il.doctor.dataset import Dataset
from manip_il.errors import ManipError
from manip_il.mcap.export import stored_pictures
from manip_il.mdp import Episode

from ..damage import DATA
from ..pictures import encoded, store_pictures, write

FRAMES, FPS = 6, 10
SIZE = (48, 64)  # height, width
KEY = "observation.images.front"
EPS = b"""%!PS-Adobe-3.0 EPSF-3.0
%%BoundingBox: 0 0 8 8
%%EndComments
0 0 8 8 rectfill
showpage
%%EOF
"""


def png(width: int, height: int) -> bytes:
    """One that says so, and holds a single row."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    header = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    rows = zlib.compress(bytes(1 + 3 * width))
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", header) + chunk(b"IDAT", rows) + chunk(b"IEND", b"")


@pytest.fixture
def marker(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """What a Ghostscript on the path would leave behind."""
    program, marker = tmp_path / "bin" / "gs", tmp_path / "marker"
    program.parent.mkdir()
    program.write_text(f"#!/bin/sh\ntouch {marker}\n")
    program.chmod(0o755)
    monkeypatch.setenv("PATH", str(program.parent), prepend=":")
    from PIL import EpsImagePlugin

    monkeypatch.setattr(EpsImagePlugin, "gs_binary", None)  # it looks for the program once
    return marker


@pytest.fixture
def pictured(tmp_path: Path, episodes: list[Episode], spec: s.RobotTaskSpec) -> Path:
    """A dataset with a column of pictures whose first one is not a PNG."""
    root = write(episodes, tmp_path / "lift", spec)
    fine = encoded(np.zeros((8, 8, 3), np.uint8))
    store_pictures(root, KEY, [EPS, *[fine] * (sum(map(len, episodes)) - 1)], (8, 8))
    return root


def test_no_reader_hands_a_picture_to_ghostscript(marker, pictured):
    found = [str(finding) for finding in cameras.check_pictures(Dataset(pictured))]
    text = "the picture in row 0 cannot be decoded: it is not a PNG or JPEG (1 row like this)"
    assert any(text in line for line in found)
    for read in (
        lambda: list(ParquetPart(DATA, 0, 1).read(pictured, KEY, 20)),
        lambda: list(stored_pictures(pictured, KEY)),
        lambda: decode_picture(EPS),
    ):
        with pytest.raises((ManipError, ValueError), match="it is not a PNG or JPEG"):
            read()
    assert not marker.exists()
    with pytest.raises(Image.UnidentifiedImageError), Image.open(io.BytesIO(EPS)) as picture:  # Pillow's own reader
        picture.load()
    assert marker.exists()  # else this shows nothing


@pytest.mark.parametrize("kind", ["GIF", "BMP", "TIFF", "WEBP"])
def test_other_formats_are_refused(kind):
    with pytest.raises(ValueError, match="not a PNG or JPEG"):
        open_picture(encoded(np.zeros((8, 8, 3), np.uint8), kind))


@pytest.mark.parametrize("kind", ["PNG", "JPEG"])
def test_a_picture_of_a_robots_camera_is_read(kind):
    level = np.full((1080, 1920, 3), 90, np.uint8)
    assert (decode_picture(encoded(level, kind)) == 90).all()


@pytest.mark.parametrize(("width", "height"), [(5_000, 5_000), (10_000, 10_000), (60_000, 60_000)])
def test_a_picture_that_would_fill_the_memory_is_refused_before_it_is_decoded(width, height):
    with warnings.catch_warnings():
        warnings.simplefilter("error")  # nor does Pillow's own warning appear
        with pytest.raises(ValueError, match="pixels"):
            decode_picture(png(width, height))


def film(path: Path, *sizes: tuple[int, int], **options: str) -> Path:
    """`FRAMES` motion JPEG frames of every size in one stream; a decoder finds the size in each."""
    with av.open(str(path), "w", options=options) as container:
        stream = container.add_stream("mjpeg", FPS)
        for part, (height, width) in enumerate(sizes):
            encoder = stream.codec_context if part == 0 else av.CodecContext.create("mjpeg", "w")
            encoder = cast(VideoCodecContext, encoder)
            encoder.height, encoder.width, encoder.pix_fmt = height, width, "yuvj420p"
            encoder.framerate, encoder.time_base = Fraction(FPS), Fraction(1, FPS)
            for number in range(FRAMES):
                frame = av.VideoFrame.from_ndarray(np.full((height, width, 3), 90, np.uint8), format="rgb24")
                frame.pts, frame.time_base = part * FRAMES + number, Fraction(1, FPS)
                for packet in encoder.encode(frame):
                    packet.stream = stream
                    container.mux_one(packet)
    return path


def refuse(path: Path, words: str) -> None:
    """By every way that videos are read."""
    with pytest.raises((ValueError, av.FFmpegError)):
        open_video(path)
    for read in (count_packets, lambda path: VideoReader().read(path, 0, FRAMES, FPS)):
        with pytest.raises(ManipError, match=words) as caught:
            read(path)
        assert str(path) in str(caught.value)
        assert "\n" not in str(caught.value)
    found = cameras.decode(path, FRAMES)
    assert found.problem
    assert not len(found.times)


def claim(path: Path, box: bytes, at: int, value: int) -> Path:
    """Overwrite a number of 32 bits, `at` bytes behind the name of a box."""
    data = bytearray(path.read_bytes())
    start = data.index(box) + len(box) + at
    data[start : start + 4] = value.to_bytes(4)
    path.write_bytes(data)
    return path


def test_a_plain_film_is_read(tmp_path):
    path = film(tmp_path / "film.mp4", SIZE)
    assert VideoReader().read(path, 2, 3, FPS).shape == (3, *SIZE, 3)
    assert count_packets(path) == len(cameras.decode(path, FRAMES).times) == FRAMES


@pytest.mark.parametrize("name", ["a:b.mp4", "concat:x|y.mp4", "http:x.mp4", "%03d.mp4"])
def test_a_name_is_a_path_and_no_address(tmp_path, monkeypatch, name):
    monkeypatch.chdir(tmp_path)
    film(tmp_path / "film.mp4", SIZE).rename(name)
    assert count_packets(Path(name)) == FRAMES


HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:1\n#EXTINF:0.6,\nsecret.mp4\n#EXT-X-ENDLIST"


@pytest.mark.parametrize("text", ["ffconcat version 1.0\nfile secret.mp4\n", HLS], ids=["list", "streaming"])
def test_a_playlist_opens_no_other_file(tmp_path, text):
    film(tmp_path / "secret.mp4", SIZE)
    path = tmp_path / "file-000.mp4"
    path.write_text(text)
    if text != HLS:
        with closing(av.open(str(path))) as container:  # FFmpeg on its own follows it
            assert sum(1 for _ in container.decode(video=0)) == FRAMES
    refuse(path, "Invalid data")


def test_pictures_have_a_largest_size(tmp_path, monkeypatch):
    monkeypatch.setattr(pictures, "MOST_PIXELS", 48 * 64 - 1)
    refuse(film(tmp_path / "film.mp4", SIZE), "its pictures have 64 x 48 pixels; expected at most 3,071 in all")


def test_pictures_may_not_grow_beyond_it(tmp_path, monkeypatch):
    path = film(tmp_path / "film.mp4", SIZE, (480, 640))
    assert len(cameras.decode(path, 2 * FRAMES).times) == 2 * FRAMES
    monkeypatch.setitem(pictures._OPTIONS, "max_pixels", str(2 * 48 * 64))
    with pytest.raises(ManipError, match="cannot read"):
        VideoReader().read(path, 0, 2 * FRAMES, FPS)
    found = cameras.decode(path, 2 * FRAMES)
    assert found.problem.startswith(f"cannot be decoded beyond {FRAMES} frames")


def test_pictures_of_two_sizes_are_one_line(tmp_path):
    path = film(tmp_path / "film.mp4", SIZE, (96, 64))
    with pytest.raises(ManipError, match=f"its pictures change their size at frame {FRAMES}"):
        VideoReader().read(path, 0, 2 * FRAMES, FPS)


def frames_of_one_size(path: Path, count: int) -> Path:
    return claim(claim(film(path, SIZE), b"stsz", 4, 1), b"stsz", 8, count)


def without_decoder(path: Path) -> Path:
    path.write_bytes(film(path, SIZE).read_bytes().replace(b"mp4v", b"zzzz").replace(b"esds", b"zzzz"))
    return path


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda path: frames_of_one_size(path, pictures.MOST_INDEXED + 1), "it declares 5,000,001 frames"),
        (lambda path: frames_of_one_size(path, 170_000_000), "it declares 170,000,000 frames"),
        (lambda path: frames_of_one_size(path, 2**32 - 1), "it declares 4,294,967,295 frames"),
        (lambda path: claim(film(path, SIZE), b"elst", 4, 10**6), "it declares 6 frames and 1,000,000 edits"),
        (lambda path: film(path, SIZE, movflags="frag_keyframe+empty_moov"), "it has a box mvex"),
        (without_decoder, "no decoder is known"),
    ],
)
def test_what_would_fill_the_memory_or_is_no_plain_film_is_refused(tmp_path, make, words):
    refuse(make(tmp_path / "film.mp4"), words)


def test_what_lies_among_the_coded_frames_is_not_looked_at(tmp_path):
    path = film(tmp_path / "film.mp4", SIZE)
    data = path.read_bytes()
    path.write_bytes(data + (24).to_bytes(4) + b"mdat" + b"moofmvexstszelst")
    assert VideoReader().read(path, 0, FRAMES, FPS).shape == (FRAMES, *SIZE, 3)


def test_decoding_stops_one_frame_behind_what_is_expected(tmp_path):
    path = film(tmp_path / "film.mp4", SIZE)
    assert [len(cameras.decode(path, expected).times) for expected in (2, 5, 6, 7)] == [3, 6, 6, 6]


def test_a_place_beyond_all_time_is_one_line(tmp_path):
    with pytest.raises(ManipError, match="cannot read"):
        VideoReader().read(film(tmp_path / "film.mp4", SIZE), 10**30, 1, FPS)


def test_an_empty_file_and_a_missing_one_are_one_line(tmp_path):
    (tmp_path / "empty.mp4").touch()
    refuse(tmp_path / "empty.mp4", "Invalid data")
    with pytest.raises(ManipError, match=r"cannot read .*missing\.mp4: No such file"):
        count_packets(tmp_path / "missing.mp4")
