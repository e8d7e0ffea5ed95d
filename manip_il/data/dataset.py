"""Read any LeRobot v3.0 dataset, ours or not, as numpy arrays, without torch.

Besides LeRobot's files, our datasets have `meta/manip_il.json` (`own`), which LeRobot's tools drop.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.camera import Camera
from manip_il.data.info import NUMBERS, PICTURES, Feature, Info, read_info, reading
from manip_il.data.parquet_files import (
    EpisodeTable,
    count_rows,
    read_episode_table,
    read_file,
    read_picture_statistics,
    read_tasks,
    to_numpy,
)
from manip_il.data.statistics import Statistics, column_statistics, read_statistics
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import Episode

UNKNOWN_TASK = UNKNOWN_ROBOT = "unknown"


@dataclass(frozen=True)
class Own:
    """Content of `meta/manip_il.json`: the spec, the environment's fingerprint, and the origin of the episodes."""

    spec: s.RobotTaskSpec
    fingerprint: Mapping[str, Any]
    provenance: Mapping[str, Any]


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
        """Content of `meta/manip_il.json`; None if there is none, as in a dataset of another program."""
        path = self.root / layout.OURS
        if not path.exists():
            return None
        with reading(path):
            ours = checks.read_json(path, "manip_il's description of a dataset")
            spec = s.RobotTaskSpec.from_json(ours["spec"])
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
    def spec(self) -> s.RobotTaskSpec:
        """The dataset's spec.

        For datasets of other programs, and after LeRobot's tools have dropped our file, it is derived from LeRobot's
        files: the task is `unknown`, and cameras are left out if their sizes differ. Raises `ManipError` for a dataset
        without actions.
        """
        if self.own is not None:
            one = len(self.tasks) == 1  # otherwise episodes have different instructions
            return dataclasses.replace(self.own.spec, instruction=self.instruction) if one else self.own.spec
        features = self.features
        if s.ACTION not in features:
            raise ManipError(f"{self.root} has no column {s.ACTION}, so there is nothing to learn from it")
        around = features.get(s.ENVIRONMENT_STATE)
        cameras = [features[key] for key in self.cameras if key.startswith(s.IMAGES) and features[key].is_rgb]
        points = next((one.labels for key, one in features.items() if key.startswith(s.KEYPOINTS)), ())
        sizes = {one.picture_size for one in cameras}
        if len(sizes) > 1:  # a spec has one size for all cameras
            cameras = []
        robot: dict[str, Any] = {**s.robot_of(self.info.robot or UNKNOWN_ROBOT)}
        return s.RobotTaskSpec(
            **robot,
            task=UNKNOWN_TASK,
            fps=self.fps,
            joint_names=features[s.ACTION].labels,
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
        """Statistics by column and name: (n,), or (channels, 1, 1) for pictures; computed if the dataset has none."""
        if (self.root / layout.STATS).exists():
            return read_statistics(self.root)
        return column_statistics(self.columns())

    @cached_property
    def data_files(self) -> list[Path]:
        """The data files in row order."""
        paths = sorted(self.root.glob(layout.DATA_FILES))
        if not paths:
            raise ManipError(f"{self.root} has no data: no file matches {layout.DATA_FILES}")
        rows = sum(map(count_rows, paths))
        if rows != len(self):
            raise ManipError(f"{self.root}: {layout.INFO} counts {len(self)} frames, its data files {rows}")
        return paths

    def columns(self, names: Sequence[str] | None = None) -> dict[str, NDArray[Any]]:
        """Read whole columns in stored order: (T,) for scalars, (T, d) for vectors; they may be read-only.

        names: by default all numeric columns. Raises `UnknownName` for an unknown column.
        """
        if names is None:
            names = [feature.key for feature in self.info.of_dtype(*NUMBERS)]
        pieces = list(self.pieces(names))
        if len(pieces) == 1:
            return pieces[0]
        return {name: np.concatenate([piece[name] for piece in pieces]) for name in names}

    def pieces(self, names: Sequence[str]) -> Iterator[dict[str, NDArray[Any]]]:
        """Yield the columns, (T,) or (T, d), of each data file. Raises what `columns` raises."""
        known = [key for key, feature in self.features.items() if feature.dtype not in PICTURES]
        for name in names:
            if name not in known:
                raise UnknownName(f"column in {self.root}", name, known)
        for path in self.data_files:
            with reading(path):
                table = read_file(path, names)
                piece = {name: to_numpy(table.column(name), self.features[name]) for name in names}
            yield piece

    def camera(self, key: str) -> Camera:
        """Return a camera's pictures, not yet decoded. Raises what `Camera.of` raises."""
        return Camera.of(self.root, self.info, self.episodes, self.data_files, key)

    def frames(self, key: str, rows: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Return a camera's decoded pictures, (B, height, width, 3), of these rows, (B,)."""
        return self.camera(key).rows(rows)

    def clip(self, key: str, episode: int) -> tuple[Path, int, int]:
        """Return where a camera's pictures of an episode are: video file, first frame in it, number of frames."""
        clips, [place] = self.episodes.clips[key], np.flatnonzero(self.episodes.index == episode)
        first = round(float(clips.starts[place]) * self.fps)
        return self.root / clips.files[place], first, int(self.episodes.length[place])

    @cached_property
    def picture_statistics(self) -> list[Statistics]:
        """Statistics of every episode's pictures, by camera."""
        return read_picture_statistics(self.root, self.cameras)

    def rows_of(self, episode: int) -> NDArray[np.int64]:
        """Return the rows of an episode, (T,). Raises `UsageError` if it does not exist."""
        if not 0 <= episode < self.info.episodes:
            raise UsageError(f"{self.root} has no episode {episode}; it has 0 to {self.info.episodes - 1}")
        table = self.episodes
        [place] = np.flatnonzero(table.index == episode)[:1]
        return np.arange(table.start[place], table.start[place] + table.length[place])

    def read_episodes(self, *, pictures: bool = True) -> Iterator[Episode]:
        """Yield the episodes of a dataset with our columns, in order, scalars as (T, 1) columns.

        pictures: include them. Success is read from `next.success`. One data file is in memory at a time.
        """
        cameras = {key: self.camera(key) for key in self.spec.image_keys} if pictures else {}
        left_out = {} if pictures else self.spec.image_keys
        shapes = {key: one["shape"] for key, one in s.features(self.spec).items() if key not in left_out}
        stored = [key for key in shapes if key not in cameras]
        texts, drawn, row = self.tasks, self.episodes.drawn, 0
        for piece in self.pieces([*stored, layout.EPISODE_INDEX, layout.TASK_INDEX]):
            index, task = (piece[name].reshape(-1) for name in (layout.EPISODE_INDEX, layout.TASK_INDEX))
            starts = np.flatnonzero(np.diff(index, prepend=-1))
            for start, stop in zip(starts, [*starts[1:], len(index)], strict=True):
                own: dict[str, NDArray[Any]] = {
                    key: camera.rows(np.arange(row + start, row + stop)) for key, camera in cameras.items()
                }
                own |= {key: piece[key][start:stop].reshape(-1, *shapes[key]) for key in stored}
                if (text := texts.get(int(task[start]))) is None:
                    raise ManipError(f"{self.root}: rows have task {task[start]}, which {layout.TASKS} lacks")
                columns, solved = {key: own[key] for key in shapes}, own[s.SUCCESS]
                ends = bool(solved.any()), bool(solved[-1])
                yield Episode(int(own[s.SEED].flat[0]), columns, *ends, text, drawn.get(int(index[start]), {}))
            row += len(index)

    def count_successes(self) -> int:
        """Return how many episodes succeeded at some step; 0 if there is no success column."""
        if s.SUCCESS not in self.features:
            return 0
        columns = self.columns([layout.EPISODE_INDEX, s.SUCCESS])
        index, success = (column.reshape(-1) for column in columns.values())
        return len(np.unique(index[success.astype(bool)]))


def joined_columns(roots: Sequence[Path], names: Sequence[str]) -> dict[str, NDArray[Any]]:
    """Read and concatenate columns, (T,) or (T, d), of several datasets; frames and episodes are renumbered.

    Raises what `Dataset.columns` raises.
    """
    pieces: list[dict[str, NDArray[Any]]] = []
    before = {layout.EPISODE_INDEX: 0, layout.INDEX: 0}
    for dataset in map(Dataset.open, roots):
        for piece in dataset.pieces(names):
            pieces.append({name: values + before[name] if name in before else values for name, values in piece.items()})
        before = {
            layout.EPISODE_INDEX: before[layout.EPISODE_INDEX] + dataset.info.episodes,
            layout.INDEX: before[layout.INDEX] + len(dataset),
        }
    shapes = {name: values.shape[1:] for name, values in pieces[0].items()}
    return {name: np.concatenate([one[name].reshape(-1, *shape) for one in pieces]) for name, shape in shapes.items()}
