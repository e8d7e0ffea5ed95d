"""Pictures from outside are PNG or JPEG of a bounded size, and no other program ever sees them."""

from __future__ import annotations

import io
import struct
import warnings
import zlib
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from manip_il.data import schema as s
from manip_il.data.frame_source import ParquetPart
from manip_il.data.pictures import open_picture
from manip_il.doctor.cameras import check_pictures
from manip_il.doctor.dataset import Dataset
from manip_il.errors import ManipError
from manip_il.mcap.export import stored_pictures
from manip_il.mcap.read import decode_picture
from manip_il.mdp import Episode

from ..damage import DATA
from ..pictures import encoded, store_pictures, write

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
    found = [str(finding) for finding in check_pictures(Dataset(pictured))]
    text = "the picture in row 0 cannot be decoded: it is not a PNG or JPEG (1 row like this)"
    assert any(text in line for line in found)
    for read in (
        lambda: list(ParquetPart(DATA, 0).read(pictured, KEY, 20)),
        lambda: list(stored_pictures(pictured, KEY)),
        lambda: decode_picture(EPS),
    ):
        with pytest.raises(ManipError, match="it is not a PNG or JPEG"):
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
        with pytest.raises(ManipError, match="pixels"):
            decode_picture(png(width, height))
