"""The gate for untrusted datasets: every file is opened once in a child process with limited memory and time.

Other readers decode a column as the parquet file's metadata says (audio, PDF, any format that Pillow knows). If a cell
for a picture has no bytes, they open its `path`, even a URL. Files that would make a reader do either are refused.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Mapping
from contextlib import closing, suppress
from pathlib import Path
from typing import Any

import av
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from manip_il import checks
from manip_il.data.camera import open_video
from manip_il.data.info import read_info
from manip_il.errors import ManipError

_PREFIXES = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")  # PNG and JPEG
_DEPTH = (b"II*\0", b"MM\0*")  # TIFF, which this program does not open
_PLAIN = ("Value", "ClassLabel", "List", "LargeList", "Sequence", "Json", "Array2D", "Array3D", "Array4D", "Array5D")
_BATCH = 64  # rows in memory at once


def check_arrived(root: Path, *, strict: bool = True) -> None:
    """Open every file of a dataset in a child process. Raises `ManipError` naming a file that is refused.

    strict: refuse damaged files, too; otherwise refuse only files that are not regular, or that crash the process or
    need too much memory or time.
    """
    checks.in_child(str(root), open_files, root, strict)


def open_files(root: Path, strict: bool = True) -> None:
    """Open every file of a dataset, in the child process. Raises `ManipError` as `check_arrived` does."""
    pictures: dict[str, tuple[bytes, ...]] = {}  # column -> allowed prefixes of its cells
    with suppress(ManipError):  # without a valid info.json nothing reads the pictures
        cameras = read_info(root).of_dtype("image")
        pictures = {one.key: _PREFIXES if one.is_rgb else (*_PREFIXES, *_DEPTH) for one in cameras}
    for path in sorted(path for path in root.rglob("*") if not path.is_dir()):
        if not path.is_file():
            raise ManipError(
                f"{path} is not a regular file; a dataset holds no pipes, devices, sockets or broken links"
            )
        checks.opening(str(path))
        try:
            _open_file(path, pictures)
        except (ManipError, OSError, ValueError, pa.ArrowException, av.FFmpegError) as error:
            if strict:
                named = checks.one_line(error) if str(path) in str(error) else f"{path}: {checks.one_line(error)}"
                raise ManipError(named) from error


def _open_file(path: Path, pictures: Mapping[str, tuple[bytes, ...]]) -> None:
    """Read a whole file of a dataset according to its suffix. Raises what reading raises."""
    if path.suffix == ".parquet":
        with pq.ParquetFile(path) as file:
            schema = file.schema_arrow
            cells = {one.name: pictures.get(one.name, _PREFIXES) for one in schema if _is_picture(one, pictures)}
            _check_types(schema, len(cells))
            row = 0
            for batch in file.iter_batches(_BATCH, use_threads=False):
                for key, prefixes in cells.items():
                    _check_cells(key, batch.column(key), prefixes, row)
                row += len(batch)
    elif path.suffix == ".mp4":
        with closing(open_video(path)) as container:
            for _ in container.demux(container.streams.video):
                pass
    elif path.suffix == ".json":
        checks.parse_json(str(path), checks.read_bytes(path, "JSON"))


def _is_picture(column: pa.Field, pictures: Collection[str]) -> bool:
    return column.name in pictures or (pa.types.is_struct(column.type) and column.type.get_field_index("path") >= 0)


def _check_types(schema: pa.Schema, pictures: int) -> None:
    """Raise `ValueError` if readers would decode more than `pictures` columns, or one as anything but an image."""
    about = (schema.metadata or {}).get(b"huggingface", b"").decode(errors="replace")
    decoded = [name for name in re.findall(r'"_type"\s*:\s*"(.*?)"', about) if name not in _PLAIN]
    if decoded != ["Image"] * len(decoded) or len(decoded) > pictures:
        raise ValueError(f"its metadata has columns decoded as {checks.shorten(decoded[-1])}; expected plain values")


def _check_cells(key: str, cells: pa.Array, prefixes: tuple[bytes, ...], first: int) -> None:
    """Raise `ValueError` unless every cell has the bytes of a picture. first: row of the first cell."""
    kind = cells.type
    place = kind.get_field_index("bytes") if pa.types.is_struct(kind) else -1
    if place < 0 or not (pa.types.is_binary(kind[place].type) or pa.types.is_large_binary(kind[place].type)):
        raise ValueError(f"column {key!r} should hold pictures as bytes; it holds {checks.shorten(str(kind))}")
    content: Any = pc.struct_field(cells, "bytes")  # pyright: ignore[reportAttributeAccessIssue]
    begins: list[bytes | None] = pc.binary_slice(content, 0, 8).to_pylist()  # pyright: ignore[reportAttributeAccessIssue]
    for row, found in enumerate(begins, first):
        if not (found or b"").startswith(prefixes):
            raise ValueError(f"column {key!r} has no PNG or JPEG in row {row:,}; expected a picture file's bytes")
