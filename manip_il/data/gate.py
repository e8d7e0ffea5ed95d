"""The gate for untrusted datasets: every file is opened once in a child process with limited memory
and time.

Other readers decode a column as the parquet file's metadata says (audio, PDF, any format that
Pillow knows). If a cell for a picture has no bytes, they open its `path`, even a URL. Only what
LeRobot and this program write passes: pictures in data files, in the columns that `info.json` calls
images, and plain values and lists everywhere else.
"""

import json
import re
from collections.abc import Collection, Mapping
from contextlib import closing
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from PIL import Image

from manip_il import checks
from manip_il.data.camera import FORMATS, open_picture, open_video
from manip_il.data.info import Feature, read_info
from manip_il.errors import ManipError

_DEPTH = (*FORMATS, "TIFF")  # this program does not decode TIFF
_PLAIN = (
    *("Value", "ClassLabel", "List", "LargeList", "Sequence", "Json"),
    *("Array2D", "Array3D", "Array4D", "Array5D"),
)
_ARRAY = re.compile(rb"datasets\.features\.features\.Array[2-5]DExtensionType")
_TYPE = re.compile(r'"_type": "?([^",}\]]*)')  # in the JSON from which `datasets` makes a feature
_BATCH = 64  # rows in memory at once


def check_arrived(root: Path) -> None:
    """Open every file of a dataset in a child process.

    Raises `ManipError` naming a file that is refused.
    """
    checks.in_child(str(root), open_files, root)


def open_files(root: Path) -> None:
    """Open every file of a dataset, in the child process.

    Raises `ManipError` as `check_arrived` does.
    """
    features = read_info(root).features
    for path in sorted(path for path in root.rglob("*") if not path.is_dir()):
        if not path.is_file():
            raise ManipError(
                f"{path} is not a regular file; a dataset holds no pipes, devices, sockets or"
                " broken links"
            )
        checks.opening(str(path))
        try:
            _open_file(path, path.relative_to(root).parts[0], features)
        except Exception as error:  # libraries raise anything, depending on the file
            reason = getattr(error, "strerror", None) or checks.one_line(error)
            raise ManipError(reason if str(path) in reason else f"{path}: {reason}") from error


def _open_file(path: Path, folder: str, features: Mapping[str, Feature]) -> None:
    """Read a whole file of a dataset according to its suffix. Raises what reading raises.

    Args:
        path: The file.
        folder: The folder at the dataset's root that holds it.
        features: The columns and cameras in `info.json`.
    """
    if path.suffix == ".parquet":
        present = features if folder == "data" else {}
        pictures = {key: one for key, one in present.items() if one.dtype == "image"}
        structs = {*pictures, *(key for key, one in present.items() if one.dtype == "language")}
        with checks.native_path(path, "a parquet file") as opened, pq.ParquetFile(opened) as file:
            _check_columns(file.schema_arrow, pictures, structs)
            row = 0
            for batch in file.iter_batches(_BATCH, use_threads=False):
                for key in pictures.keys() & {*batch.schema.names}:
                    _check_cells(pictures[key], batch.column(key), row)
                row += len(batch)
    elif path.suffix == ".mp4":
        camera = features.get(path.parent.parent.name)
        with closing(open_video(path, camera and camera.picture_size)) as container:
            for _ in container.demux(container.streams.video):
                pass
    elif path.suffix == ".json":
        checks.parse_json(str(path), checks.read_bytes(path, "JSON"))


def _check_columns(schema: pa.Schema, pictures: Collection[str], structs: Collection[str]) -> None:
    """Raise `ValueError` if a column has another type, or readers would decode it otherwise, than
    `info.json` says.

    Args:
        schema: The columns' types, and the metadata from which Hugging Face's `datasets` decodes
            them.
        pictures: The columns of pictures.
        structs: The columns that may hold structs.
    """
    for column in schema:
        if not _is_plain(column, column.name in structs):
            raise ValueError(f"column {column.name!r} holds {column.type}; expected plain values")
    about = checks.parse_json("its metadata", (schema.metadata or {}).get(b"huggingface", b"{}"))
    for key, feature in (about.get("info", {}).get("features") or {}).items():
        allowed = (*_PLAIN, "Image") if key in pictures else _PLAIN
        if not {*_TYPE.findall(json.dumps(feature))} <= {*allowed}:
            raise ValueError(
                f"column {key!r} is decoded as {checks.shorten(feature)}; expected plain values"
            )


def _is_plain(column: pa.Field, structs: bool) -> bool:
    """Return whether a column's type consists of plain values, lists and, if they are allowed,
    structs.
    """
    kind, extension = column.type, (column.metadata or {}).get(b"ARROW:extension:name")
    if extension is not None and not _ARRAY.fullmatch(extension):
        return False
    if pa.types.is_struct(kind) and not structs:  # a map holds structs
        return False
    if isinstance(kind, pa.BaseExtensionType):
        return kind == pa.json_()
    return all(_is_plain(kind.field(place), structs) for place in range(kind.num_fields))


def _check_cells(camera: Feature, cells: pa.Array, first: int) -> None:
    """Raise `ValueError` unless every cell holds a picture of the camera's size. first: row of
    the first cell.
    """
    contents: Any = pc.struct_field(cells, "bytes")  # pyright: ignore[reportAttributeAccessIssue]
    for row, content in enumerate(contents.to_pylist(), first):
        try:
            open_picture(content, camera.picture_size, FORMATS if camera.is_rgb else _DEPTH)
        except Image.UnidentifiedImageError:
            raise ValueError(f"column {camera.key!r} has no PNG or JPEG in row {row:,}") from None
