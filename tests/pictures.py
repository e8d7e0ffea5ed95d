"""Episodes whose pictures hold their number, as twelve squares, light for a one.

And the frames of video files.
"""

import io
import json
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from PIL import Image

from manip_il.data import lerobot_layout
from manip_il.data import schema as s
from manip_il.data.camera import open_video
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import INFO
from manip_il.data.lerobot_write import write_dataset
from manip_il.mdp import Episode

from .damage import DATA, edit_json

SIDE, COLUMNS, ROWS = 24, 4, 3  # smaller squares, and the default compression may lose one
LENGTHS = (7, 1, 13)


def with_cameras(spec: s.EnvironmentSpec, *cameras: str) -> s.EnvironmentSpec:
    return replace(spec, cameras=cameras, image_size=(ROWS * SIDE, COLUMNS * SIDE))


def picture(number: int) -> np.ndarray:
    bits = np.array([number >> bit & 1 for bit in range(ROWS * COLUMNS)]).reshape(ROWS, COLUMNS)
    levels = np.kron(30 + 190 * bits, np.ones((SIDE, SIDE)))
    return np.stack([levels, 0.9 * levels, 0.8 * levels], axis=-1).astype(np.uint8)


def number_of(picture: np.ndarray) -> int:
    """The number that a picture (height, width, 3) with levels 0 to 255 shows."""
    squares = picture.reshape(ROWS, SIDE, COLUMNS, SIDE, 3).mean(axis=(1, 3, 4))
    return sum(1 << bit for bit, level in enumerate(squares.flat) if level > 110)


def numbers_of(pictures: np.ndarray) -> list[int]:
    return [number_of(picture) for picture in pictures]


def numbered_episodes(
    make_episode: Callable[..., Episode], spec: s.EnvironmentSpec, count: int = 3
) -> list[Episode]:
    """Of lengths 7, 1 and 13 in turn.

    Pictures count on through all episodes of one camera, then of the next.
    """
    lengths = [LENGTHS[index % 3] for index in range(count)]
    starts = np.cumsum([0, *lengths])
    episodes: list[Episode] = []
    for index, length in enumerate(lengths):
        pictures = {
            key: np.stack([picture(offset * starts[-1] + starts[index] + t) for t in range(length)])
            for offset, key in enumerate(spec.image_keys)
        }
        plain = make_episode(100 + index, length)
        columns = plain.columns | pictures
        episodes.append(replace(plain, columns={key: columns[key] for key in s.features(spec)}))
    return episodes


def encoded(picture: np.ndarray, kind: str = "PNG") -> bytes:
    """A picture as a PNG or another format of Pillow's."""
    stream = io.BytesIO()
    Image.fromarray(picture).save(stream, kind)
    return stream.getvalue()


def store_pictures(root: Path, key: str, pictures: list[bytes], size: tuple[int, int]) -> Path:
    """Give a dataset a camera of LeRobot's dtype `image`, whose pictures are in its data file.

    Return that file.
    """
    path = root / DATA
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    cells = pa.array([{"bytes": content, "path": None} for content in pictures], kind)
    pq.write_table(pq.read_table(path).append_column(key, cells), path, row_group_size=5)
    feature: dict[str, Any] = {
        "dtype": "image",
        "shape": [*size, 3],
        "names": ["height", "width", "channels"],
    }
    edit_json(root / INFO, lambda info: info["features"].update({key: feature}))
    return path


def write(
    episodes: list[Episode],
    root: Path,
    spec: s.EnvironmentSpec,
    size: float | None = None,
    **options: Any,
) -> Path:
    """Write a dataset with options of `write_dataset`. size: of its files [MB]."""
    with pytest.MonkeyPatch.context() as patch:
        for name in ("DATA_FILES_SIZE_IN_MB", "VIDEO_FILES_SIZE_IN_MB") if size else ():
            patch.setattr(lerobot_layout, name, size)
        write_dataset(episodes, root, spec, **({"fingerprint": {}} | options))
    return root


def read_episodes(root: Path) -> Iterator[Episode]:
    """The episodes of a dataset with our columns, in order, as they were written."""
    dataset = Dataset.open(root)
    shapes = {key: one["shape"] for key, one in s.features(dataset.spec).items()}
    names = [key for key in shapes if key not in dataset.spec.image_keys]
    for number, one in enumerate(dataset.stored_episodes(names)):
        columns = {
            key: dataset.frames(key, dataset.rows_of(number)) for key in dataset.spec.image_keys
        }
        columns |= {key: one.columns[key].reshape(-1, *shapes[key]) for key in names}
        solved, drawn = columns[s.SUCCESS], json.loads(one.others[lerobot_layout.DRAWN] or "{}")
        ends = bool(solved.any()), bool(solved[-1])
        yield Episode(
            int(columns[s.SEED][0, 0]),
            {key: columns[key] for key in shapes},
            *ends,
            one.tasks[0],
            drawn,
        )


def assert_comes_back(root: Path, episodes: list[Episode]) -> None:
    """A dataset holds these episodes: numbers bit for bit, pictures by the number that they
    show.
    """
    for mine, yours in zip(read_episodes(root), episodes, strict=True):
        assert (mine.seed, mine.success, mine.success_at_end) == (
            yours.seed,
            yours.success,
            yours.success_at_end,
        )
        assert list(mine.columns) == list(yours.columns)
        for key, values in yours.columns.items():
            assert mine.columns[key].dtype == values.dtype
            if key.startswith(s.IMAGES):
                assert numbers_of(mine.columns[key]) == numbers_of(values)
            else:
                np.testing.assert_array_equal(mine.columns[key], values, err_msg=key)


def episode_frames(root: Path, key: str, episode: int) -> np.ndarray:
    """An episode's pictures of one camera, decoded, (T, height, width, 3)."""
    dataset = Dataset.open(root)
    return dataset.frames(key, dataset.rows_of(episode))


def video_rows(root: Path) -> dict[Path, int]:
    """Every video file of a dataset -> the frames that the rows of `meta/episodes` put into it."""
    rows: Counter[Path] = Counter()
    for key in Dataset.open(root).cameras:
        for part in Dataset.open(root).camera(key).parts:
            rows[root / part.path] += part.count
    return dict(rows)


def count_frames(path: Path) -> int:
    """The frames that a whole video file decodes to."""
    with closing(open_video(path)) as container:
        return sum(1 for _ in container.decode(video=0))
