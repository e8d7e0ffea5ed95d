"""Read `meta/info.json` of any LeRobot dataset."""

import math
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.errors import ManipError, UsageError

PICTURES = ("video", "image")
NUMBERS = (
    *("float16", "float32", "float64"),
    *("int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64", "bool"),
)
INDEX_FEATURES = (*layout.INDEX_DTYPES,)

_PATHS = {"data_path": layout.DATA_PATH, "video_path": layout.VIDEO_PATH}
_MOST = 2**53  # highest accepted number of frames or episodes


@dataclass(frozen=True)
class Feature:
    """One column or camera.

    Attributes:
        key: Its name.
        dtype: Its type as LeRobot names it, such as `float32` or `video`.
        shape: Shape of one frame.
        table: Its whole entry in `info.json`.
    """

    key: str
    dtype: str
    shape: tuple[int, ...]
    table: dict[str, Any]

    @property
    def names(self) -> Any:
        """Names of its values or axes: a list, lists by group, or None."""
        return self.table.get("names")

    @property
    def details(self) -> dict[str, Any]:
        """Further entries, such as a film's codec."""
        return self.table.get("info") or self.table.get("video_info") or {}

    @property
    def size(self) -> int:
        """Number of values in a frame."""
        return math.prod(self.shape)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each value: from `info.json` (a list, or lists by group), else
        `<column>.<index>`.
        """
        names: Any = self.names
        groups = cast(dict[str, Any], names).values() if isinstance(names, dict) else [names]
        found = [
            str(name)
            for group in groups
            if isinstance(group, list)
            for name in cast(list[Any], group)
        ]
        return (
            tuple(found)
            if len(found) == self.size
            else tuple(f"{self.key}.{place}" for place in range(self.size))
        )

    @property
    def is_rgb(self) -> bool:
        """Whether it is a camera with RGB pictures, not depth."""
        depth = self.details.get("is_depth_map") or self.details.get("video.is_depth_map")
        return (
            self.dtype in PICTURES
            and 3 * math.prod(self.picture_size) == self.size > 0
            and not depth
        )

    @property
    def picture_size(self) -> tuple[int, int]:
        """A picture's height and width [pixels]: the axes named `height` and `width`, else the
        first two axes.
        """
        names = cast(list[Any], self.names) if isinstance(self.names, list) else []
        if "height" in names and "width" in names and len(names) == len(self.shape):
            return self.shape[names.index("height")], self.shape[names.index("width")]
        return (self.shape[0], self.shape[1]) if len(self.shape) > 1 else (0, 0)


@dataclass(frozen=True)
class Info:
    """Content of `meta/info.json`.

    Attributes:
        fps: Rate of the frames [Hz].
        features: Name of a column or camera -> its description.
        episodes: Number of episodes.
        frames: Number of frames.
        tasks: Number of tasks, if known.
        robot: LeRobot's `robot_type`.
    """

    fps: float
    features: dict[str, Feature]
    episodes: int
    frames: int
    tasks: int | None
    robot: str

    def of_dtype(self, *dtypes: str) -> list[Feature]:
        """Return features of these dtypes."""
        return [feature for feature in self.features.values() if feature.dtype in dtypes]


@contextmanager
def reading(path: Path) -> Generator[None]:
    """Turn every error raised while a file is read into a one-line `ManipError` that names the
    file.
    """
    try:
        yield
    except Exception as error:  # libraries raise anything, depending on the file
        if isinstance(error, ManipError) and str(path) in str(error):
            raise
        reason = getattr(error, "strerror", None) or checks.one_line(error) or type(error).__name__
        raise ManipError(
            f"cannot read {path}: {reason}; run `manip-il data check` to see what is wrong"
        ) from error


def read_info(root: Path) -> Info:
    """Read `meta/info.json` of a dataset.

    Raises `UsageError` if there is no such folder, `ManipError` if the file is missing, has another
    version, or names files otherwise than LeRobot does.
    """
    path = root / layout.INFO
    if not root.exists():
        raise UsageError(
            f"{root} does not exist; expected a LeRobot v3.0 dataset; one on the Hub must be pulled"
            " first: manip-il pull hf://datasets/USER/NAME FOLDER"
        )
    if not path.exists():
        raise ManipError(f"{root} is not a LeRobot dataset: {layout.INFO} is missing")
    raw = checks.read_json(path, "a dataset's description")
    version = raw.get("codebase_version")
    if version != layout.VERSION:
        older = "; LeRobot converts datasets of v2.1" if version == "v2.1" else ""
        raise ManipError(
            f"{path}: codebase_version is {checks.shorten(version)}; expected"
            f" {layout.VERSION!r}{older}"
        )
    with reading(path):
        for key, template in _PATHS.items():
            if (found := raw.get(key) or template) != template:
                raise ManipError(
                    f"{key} is {checks.shorten(found)}; expected {template!r}, as LeRobot names its"
                    " files"
                )
        tasks = raw.get("total_tasks")
        return Info(
            fps=checks.number("fps", raw["fps"], 1, 1e6),
            features={key: _feature(key, table) for key, table in raw["features"].items()},
            episodes=checks.whole("total_episodes", raw["total_episodes"], 0, _MOST),
            frames=checks.whole("total_frames", raw["total_frames"], 0, _MOST),
            tasks=None if tasks is None else checks.whole("total_tasks", tasks, 0, _MOST),
            robot=checks.text("robot_type", raw.get("robot_type") or "", checks.LONGEST_NAME),
        )


def _feature(key: str, table: dict[str, Any]) -> Feature:
    checks.name("a feature", key)  # folders and files are named after it
    shape = tuple(checks.whole("a size in a shape", size, 0, _MOST) for size in table["shape"])
    return Feature(key, table["dtype"], shape, table)
