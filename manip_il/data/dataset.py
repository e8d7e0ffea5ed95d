"""Read any LeRobot v3.0 dataset, ours or not, as numpy arrays, without torch.

Besides LeRobot's files, our datasets have `meta/manip_il.json` (`own`), which LeRobot's tools drop.

One or more datasets as one training set, with the metadata attributes that LeRobot's factories
expect.
"""

from __future__ import annotations

import dataclasses
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property, reduce
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.camera import Camera, FrameRange
from manip_il.data.info import NUMBERS, PICTURES, Feature, Info, read_info, reading
from manip_il.data.lerobot_layout import Features
from manip_il.data.parquet_files import (
    Column,
    EpisodeTable,
    count_rows,
    read_episode_table,
    read_file,
    read_picture_statistics,
    read_tasks,
    to_numpy,
)
from manip_il.data.statistics import Statistics, column_statistics, pool, read_statistics
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import I64

UNKNOWN_TASK = UNKNOWN_ROBOT = "unknown"
_NUMBERED = (layout.EPISODE_INDEX, layout.INDEX, layout.TASK_INDEX)


@dataclass(frozen=True)
class Own:
    """Content of `meta/manip_il.json`.

    Attributes:
        spec: The environment's description.
        fingerprint: The environment's fingerprint.
        provenance: The origin of the episodes.
    """

    spec: s.EnvironmentSpec
    fingerprint: Mapping[str, Any]
    provenance: Mapping[str, Any]


@dataclass(frozen=True)
class EpisodeData:
    """An episode that is written to a dataset, or as it is stored in one.

    Its films and statistics of pictures are copied for the cameras that are not among its columns.

    Args:
        columns: (T,) or (T, ...), pictures (T, height, width, 3); stored text and PNG files are
            Arrow arrays.
        tasks: The text of every frame.
        others: Values in the columns of `meta/episodes` that LeRobot does not have.
        films: Its frames in the stored films of each camera.
        picture_statistics: Stored statistics of its pictures, by camera.
    """

    columns: Mapping[str, Column]
    tasks: Sequence[str]
    others: Mapping[str, Any] = field(default_factory=dict)
    films: Mapping[str, FrameRange] = field(default_factory=dict)
    picture_statistics: Statistics = field(default_factory=dict)


class Dataset:
    """A dataset on disk. Tables are read once, on first use; columns and pictures at every call.

    Raises `ManipError` naming a file that cannot be read.
    """

    def __init__(self, root: Path, info: Info):
        self.root, self.info = root, info

    @classmethod
    def open(cls, root: Path) -> Dataset:
        """Open a folder. Raises `ManipError` if it is not a dataset."""
        return cls(Path(root), read_info(Path(root)))

    def __len__(self) -> int:
        """Return the number of frames."""
        return self.info.frames

    @property
    def fps(self) -> float:
        """Frame rate [Hz]."""
        return self.info.fps

    @property
    def features(self) -> Mapping[str, Feature]:
        """Columns and cameras by name."""
        return self.info.features

    @property
    def cameras(self) -> list[str]:
        """Names of the columns of pictures, `observation.images.<camera>`."""
        return [feature.key for feature in self.info.of_dtype(*PICTURES)]

    @cached_property
    def own(self) -> Own | None:
        """Content of `meta/manip_il.json`.

        None if there is none, as in a dataset of another program.
        """
        path = self.root / layout.OURS
        if not path.exists():
            return None
        with reading(path):
            ours = checks.read_json(path, "manip_il's description of a dataset")
            spec = s.EnvironmentSpec.from_json(ours["spec"])
            return Own(spec, dict(ours["fingerprint"]), dict(ours["provenance"]))

    @property
    def fingerprint(self) -> Mapping[str, Any]:
        """The environment's fingerprint; empty in a dataset of another program."""
        return self.own.fingerprint if self.own else {}

    @property
    def provenance(self) -> Mapping[str, Any]:
        """Origin of the episodes; empty in a dataset of another program."""
        return self.own.provenance if self.own else {}

    @cached_property
    def spec(self) -> s.EnvironmentSpec:
        """The dataset's spec.

        For datasets of other programs, and after LeRobot's tools have dropped our file, it is
        derived from LeRobot's files: the task is `unknown`, and cameras are left out if their sizes
        differ. Raises `ManipError` for a dataset without actions.
        """
        if self.own is not None:
            one = len(self.tasks) == 1  # otherwise episodes have different instructions
            return (
                dataclasses.replace(self.own.spec, instruction=self.instruction)
                if one
                else self.own.spec
            )
        features = self.features
        if s.ACTION not in features:
            raise ManipError(
                f"{self.root} has no column {s.ACTION}, so there is nothing to learn from it"
            )
        moved = features[s.ACTION]
        mine = features.get(s.STATE)
        around = features.get(s.ENVIRONMENT_STATE)
        cameras = [
            features[key]
            for key in self.cameras
            if key.startswith(s.IMAGES) and features[key].is_rgb
        ]
        points = next(
            (one.labels for key, one in features.items() if key.startswith(s.KEYPOINTS)), ()
        )
        sizes = {one.picture_size for one in cameras}
        if len(sizes) > 1:  # a spec has one size for all cameras
            cameras = []
        robot: dict[str, Any] = {**s.robot_of(self.info.robot or UNKNOWN_ROBOT)}
        return s.EnvironmentSpec(
            **robot,
            task=UNKNOWN_TASK,
            fps=self.fps,
            joint_names=moved.labels,
            state_names=mine.labels if mine and mine.labels != moved.labels else (),
            environment_state_names=around.labels if around else (),
            sim_state_size=features[s.SIM_STATE].size if s.SIM_STATE in features else 0,
            instruction=self.instruction,
            cameras=tuple(one.key.removeprefix(s.IMAGES) for one in cameras),
            image_size=sizes.pop() if cameras else (0, 0),
            video=not any(one.dtype == "image" for one in cameras),
            keypoints=tuple(one.removesuffix(".across") for one in points[::3]),
        )

    @cached_property
    def tasks(self) -> dict[int, str]:
        """Task texts by `task_index`."""
        return read_tasks(self.root)

    @property
    def instruction(self) -> str:
        """The text of the first task; "" if there is none."""
        return next(iter(self.tasks.values()), "")

    @cached_property
    def episodes(self) -> EpisodeTable:
        """The table of episodes: their frames, tasks and random draws."""
        return read_episode_table(self.root, self.info)

    @cached_property
    def statistics(self) -> Statistics:
        """Statistics by column and name: (n,), or (channels, 1, 1) for pictures.

        Computed if the dataset has none.
        """
        if (self.root / layout.STATS).exists():
            return read_statistics(self.root)
        return column_statistics(self.columns())

    @property
    def data_files(self) -> list[Path]:
        """The data files in row order."""
        return [part.path for part in self._cells]

    @cached_property
    def _cells(self) -> list[FrameRange]:
        """The rows of each data file."""
        found: list[FrameRange] = []
        rows = 0
        for path in sorted(self.root.glob(layout.DATA_FILES)):
            found.append(FrameRange(path, 0, count_rows(path), rows))
            rows += found[-1].count
        if rows != len(self) or not found:
            raise ManipError(
                f"{self.root}: {layout.INFO} counts {len(self)} frames, its data files {rows}"
            )
        return found

    def columns(self, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Read whole columns in stored order.

        Args:
            names: The columns, by default all numeric ones.

        Returns:
            Column -> values, (T,) for scalars, (T, d) for vectors; they may be read-only.

        Raises:
            UnknownName: for an unknown column.
        """
        if names is None:
            names = [feature.key for feature in self.info.of_dtype(*NUMBERS)]
        known = [key for key, feature in self.features.items() if feature.dtype not in PICTURES]
        for name in names:
            if name not in known:
                raise UnknownName(f"column in {self.root}", name, known)
        pieces = [self._read(path, names) for path in self.data_files]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}

    def _read(self, path: Path, names: Sequence[str]) -> dict[str, Column]:
        """Read columns of a data file: numbers as numpy arrays, others as Arrow arrays."""
        with reading(path):
            table = read_file(path, names)
            return {name: to_numpy(table.column(name), self.features[name]) for name in names}

    def camera(self, key: str) -> Camera:
        """Find a camera's pictures without decoding them.

        Raises `UnknownName` for a column that is not a camera, and `ManipError` for depth maps or
        if the dataset's files do not hold each frame exactly once.
        """
        if key not in self.cameras:
            raise UnknownName(f"camera in {self.root}", key, self.cameras)
        feature = self.features[key]
        if not feature.is_rgb:
            raise ManipError(
                f"{key} of {self.root} has shape {feature.shape}; expected RGB pictures"
            )
        films = feature.dtype == "video"
        found = self._film_ranges(key) if films else self._cells
        parts = sorted((part for part in found if part.count), key=lambda part: part.row)
        ends = np.cumsum([0, *(part.count for part in parts)]).tolist()
        if [*(part.row for part in parts), len(self)] != ends:
            raise ManipError(
                f"{self.root}: the files of {key} do not hold each of the {len(self)} frames"
                " exactly once"
            )
        return Camera(key, self.fps, feature.picture_size, films, tuple(parts))

    def _film_ranges(self, key: str) -> list[FrameRange]:
        """Return where a camera's films hold each episode."""
        table = self.episodes
        rows = zip(table.clips[key], table.length.tolist(), table.start.tolist(), strict=True)
        return [
            FrameRange(self.root / file, round(start * self.fps), length, row)
            for (file, start), length, row in rows
        ]

    def frames(self, key: str, rows: I64) -> NDArray[np.uint8]:
        """Return a camera's decoded pictures, (B, height, width, 3), of these rows, (B,)."""
        return self.camera(key).rows(rows)

    def rows_of(self, episode: int) -> I64:
        """Return the rows of an episode, (T,). Raises `UsageError` if it does not exist."""
        if not 0 <= episode < self.info.episodes:
            raise UsageError(
                f"{self.root} has no episode {episode}; it has 0 to {self.info.episodes - 1}"
            )
        table = self.episodes
        [place] = np.flatnonzero(table.index == episode)[:1]
        return np.arange(table.start[place], table.start[place] + table.length[place])

    @property
    def stored_features(self) -> layout.Features:
        """The features in `info.json`, with everything that it says of them, without LeRobot's
        index columns.
        """
        return {
            key: one.table for key, one in self.features.items() if key not in layout.INDEX_DTYPES
        }

    @property
    def other_tables(self) -> list[Path]:
        """The tables in `meta/` that are not LeRobot's, such as texts of subtasks."""
        return [
            path for path in self.root.glob("meta/*.parquet") if path != self.root / layout.TASKS
        ]

    def texts(self, numbers: I64) -> list[str]:
        """Return the task text of each `task_index`, (T,).

        Raises `ManipError` for an index without a text.
        """
        if missing := set(numbers.tolist()) - self.tasks.keys():
            raise ManipError(
                f"{self.root}: rows have task {min(missing)}, which {layout.TASKS} lacks"
            )
        return [self.tasks[number] for number in numbers.tolist()]

    def stored_episodes(self, names: Sequence[str] | None = None) -> Iterator[EpisodeData]:
        """Yield the episodes as they are stored, in order; one data file is in memory at a time.

        Args:
            names: Columns to read, by default all in data files, except the numbers of rows,
                episodes and tasks.
        """
        if names is None:
            names = [
                key
                for key, one in self.features.items()
                if one.dtype != "video" and key not in _NUMBERED
            ]
        table = self.episodes
        films = {key: self._film_ranges(key) for key in table.clips}
        statistics = read_picture_statistics(self.root, self.cameras)
        undrawn = {layout.DRAWN: "{}"} if s.SIM_STATE in self.features else {}
        for cells in self._cells:
            columns = self._read(cells.path, [*names, layout.TASK_INDEX])
            texts = self.texts(columns.pop(layout.TASK_INDEX))
            for place in np.flatnonzero(
                (table.start >= cells.row) & (table.start < cells.row + cells.count)
            ):
                rows = slice(table.start[place] - cells.row, table.stop[place] - cells.row)
                yield EpisodeData(
                    columns={name: column[rows] for name, column in columns.items()},
                    tasks=texts[rows],
                    others=undrawn | table.others[place],
                    films={key: ranges[place] for key, ranges in films.items()},
                    picture_statistics=statistics[place],
                )

    def count_successes(self) -> int:
        """Return how many episodes succeeded at some step; 0 if there is no success column."""
        if s.SUCCESS not in self.features:
            return 0
        columns = self.columns([layout.EPISODE_INDEX, s.SUCCESS])
        index, success = (column.reshape(-1) for column in columns.values())
        return len(np.unique(index[success.astype(bool)]))


def joined_columns(
    datasets: Sequence[Dataset | Path], names: Sequence[str]
) -> dict[str, NDArray[Any]]:
    """Read and concatenate columns, (T,) or (T, d), of several datasets.

    Frames and episodes are renumbered.

    Raises what `Dataset.columns` raises.
    """
    pieces: list[dict[str, NDArray[Any]]] = []
    episodes = frames = 0
    for given in datasets:
        dataset = given if isinstance(given, Dataset) else Dataset.open(given)
        columns = dataset.columns(names)
        for name, before in ((layout.EPISODE_INDEX, episodes), (layout.INDEX, frames)):
            if name in columns:
                columns[name] = columns[name] + before
        pieces.append(columns)
        episodes += dataset.info.episodes
        frames += len(dataset)
    return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}


# from LeRobot, for every camera
_IMAGENET = {"mean": (0.485, 0.456, 0.406), "std": (0.229, 0.224, 0.225)}


class JoinedDatasets:
    """Several datasets; frames are numbered in the given order.

    Args:
        datasets: At least one dataset.

    Attributes:
        features: LeRobot's table of the columns and cameras that every dataset has, with equal
            shapes and without depth.
        stats: Statistics over all frames. Cameras have ImageNet's mean and std, as in
            `lerobot-train`; their other statistics are the first dataset's.
        tasks: Texts of the tasks, each text once.
    """

    table: dict[str, NDArray[Any]]  # numeric columns, once training has read them

    def __init__(self, datasets: Sequence[Dataset]):
        self.datasets, first = tuple(datasets), datasets[0]
        self.repo_id, self.fps = f"local/{first.root.name}", first.fps
        self.features: Features = {
            key: {"dtype": one.dtype, "shape": one.shape, "names": one.names}
            for key, one in first.features.items()
            if all(
                key in other.features and other.features[key].shape == one.shape
                for other in self.datasets
            )
            and (one.is_rgb or one.dtype not in PICTURES)
        }
        self.camera_keys = [key for key, one in self.features.items() if one["dtype"] in PICTURES]
        self.stats = self._statistics()
        self.tasks = list(
            dict.fromkeys(text for one in self.datasets for text in one.tasks.values())
        )

    def joint_tasks(self, own: I64) -> I64:
        """Return every frame's index in `tasks`, (N,), given its `task_index` in its own dataset,
        (N,).

        Raises `ManipError` for an index without a text.
        """
        places = {text: place for place, text in enumerate(self.tasks)}
        pieces = np.split(own, np.cumsum([*map(len, self.datasets)])[:-1])
        texts = [dataset.texts(piece) for dataset, piece in zip(self.datasets, pieces, strict=True)]
        return np.array([places[text] for text in itertools.chain(*texts)])

    def _statistics(self) -> Statistics:
        pooled = reduce(pool, (one.statistics for one in self.datasets))
        numbers = {key: pooled[key] for key in self.features if key in pooled}
        imagenet = {
            name: np.array(values, np.float32).reshape(3, 1, 1)
            for name, values in _IMAGENET.items()
        }
        cameras = {
            key: self.datasets[0].statistics.get(key, {}) | imagenet for key in self.camera_keys
        }
        return numbers | cameras
