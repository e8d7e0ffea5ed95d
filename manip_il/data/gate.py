"""The gate for what arrives from outside: every file is opened once in a child process with bounded memory and time.

A dataset also says what other readers open besides: `datasets` takes the type of a column from a parquet file's
metadata and decodes what is in it by that type (audio, PDF, any format that Pillow knows), and where a cell has no
bytes, what its `path` leads to, an address too. Such files are refused.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any, cast

import av
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from manip_il import checks
from manip_il.data.dataset import find_irregular
from manip_il.data.info import InvalidInfo, read_info
from manip_il.data.pictures import open_video
from manip_il.errors import ManipError

_PICTURE = "Image"
_PLAIN = (
    *("Value", "ClassLabel", "List", "LargeList", "Sequence", "Json", "Translation", "TranslationVariableLanguages"),
    *("Array2D", "Array3D", "Array4D", "Array5D"),
)  # types of `datasets` that hold numbers and text as they are stored
_BEGIN = (b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff")  # PNG and JPEG
_DEPTH = (b"II*\0", b"MM\0*")  # TIFF, which this program does not open
_BATCH = 64  # cells held at once


def check_arrived(root: Path, *, strict: bool = True) -> None:
    """Open every file of a dataset in a child process. Raises `ManipError` naming the file that does not pass.

    strict: refuse what is damaged, too; else only what needs too much memory or time or ends the process.
    """
    checks.in_child(str(root), open_files, root, strict)


def open_files(root: Path, strict: bool = True) -> None:
    """Open every file of a dataset, in the child process. Raises `ManipError` as `check_arrived` does."""
    for path in find_irregular(root):
        raise ManipError(f"{path} is not a regular file; a dataset holds no pipes, devices, sockets or broken links")
    declared = _declared_pictures(root)
    for path in sorted(path for path in root.rglob("*") if path.is_file()):
        checks.opening(str(path))
        try:
            open_file(path, declared)
        except (ManipError, OSError, ValueError, pa.ArrowException, av.FFmpegError) as error:
            if strict:
                named = checks.one_line(error) if str(path) in str(error) else f"{path}: {checks.one_line(error)}"
                raise ManipError(named) from error


def open_file(path: Path, declared: Mapping[str, bool]) -> None:
    """Read a file of a dataset to its end, by its suffix. Raises whatever reading it raises.

    declared: the columns that the dataset's description calls pictures, and whether each is depth.
    """
    if path.suffix == ".parquet":
        check_pictures(path, declared)
        with pq.ParquetFile(path) as file:
            for _ in file.iter_batches(_BATCH, use_threads=False):
                pass
    elif path.suffix == ".mp4":
        with closing(open_video(path)) as container:
            for _ in container.demux(container.streams.video):
                pass
    elif path.suffix == ".json":
        checks.parse_json(str(path), checks.read_bytes(path, "JSON", checks.LARGEST_JSON), nan_is_none=True)


def _declared_pictures(root: Path) -> dict[str, bool]:
    """The columns that the dataset's description calls pictures, and whether each is depth."""
    try:
        features = read_info(root).of_dtype("image")
    except InvalidInfo:
        return {}  # no reader gets to its pictures
    return {feature.key: not feature.is_rgb for feature in features}


def picture_columns(schema: pa.Schema) -> list[str]:
    """Return the columns that a file's metadata has decoded as pictures. Raises `ValueError` for any other decoder."""
    about = checks.parse_json("its metadata", (schema.metadata or {}).get(b"huggingface", b"{}"))
    info = about.get("info") if isinstance(about, dict) else None
    features = cast(dict[str, Any], info).get("features") if isinstance(info, dict) else None
    columns = cast(dict[str, Any], features) if isinstance(features, dict) else {}
    found = [key for key, feature in columns.items() if isinstance(feature, dict) and feature.get("_type") == _PICTURE]
    for key, feature in columns.items():
        if key not in found and (decoders := [name for name in _types(feature) if name not in _PLAIN]):
            name = checks.shorten(decoders[0])
            raise ValueError(f"its metadata has column {checks.shorten(key)} decoded as {name}; expected plain values")
    return found


def check_pictures(path: Path, declared: Mapping[str, bool]) -> None:
    """Raise `ManipError` unless every picture of a data file is in it, as PNG or JPEG, depth as TIFF, too.

    declared: as for `open_file`; columns that the file's own metadata calls pictures count, too.
    """
    with pq.ParquetFile(path) as file:
        try:
            columns = {*declared, *picture_columns(file.schema_arrow)} & set(file.schema_arrow.names)
            for key in sorted(columns):
                allowed, row = (*_BEGIN, *(_DEPTH if declared.get(key) else ())), 0
                for batch in file.iter_batches(_BATCH, columns=[key], use_threads=False):
                    for begin in _begins(batch.column(0)):
                        if not (begin or b"").startswith(allowed):
                            raise ValueError(f"column {key!r} has no PNG or JPEG in row {row:,}; expected its bytes")
                        row += 1
        except (ValueError, pa.ArrowException) as error:
            raise ManipError(f"{path}: {checks.one_line(error)}") from error


def _types(feature: Any) -> Iterator[Any]:
    """The names of all types in a feature, however nested."""
    if isinstance(feature, list):
        for one in cast(list[Any], feature):
            yield from _types(one)
    elif isinstance(feature, dict):
        table = cast(dict[str, Any], feature)
        if "_type" in table and not isinstance(table["_type"], dict):  # else a field of that name, as `datasets` has it
            yield table["_type"]
        for one in table.values():
            yield from _types(one)


def _begins(cells: pa.Array) -> list[bytes | None]:
    """The first bytes of the pictures, as many as tell the format; None for one that is not there."""
    if not pa.types.is_struct(cells.type) or cells.type.get_field_index("bytes") < 0:
        raise ValueError(f"a column of pictures holds {checks.shorten(str(cells.type))}; expected their bytes")
    content: Any = pc.struct_field(cells, "bytes")  # pyright: ignore[reportAttributeAccessIssue]
    if not (pa.types.is_binary(content.type) or pa.types.is_large_binary(content.type)):
        raise ValueError(f"a column of pictures holds {checks.shorten(str(content.type))}; expected their bytes")
    begins: list[bytes | None] = pc.binary_slice(content, 0, 8).to_pylist()  # pyright: ignore[reportAttributeAccessIssue]
    return begins
