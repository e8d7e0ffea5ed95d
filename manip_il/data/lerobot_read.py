"""Read LeRobot v3.0 datasets as whole columns: numpy arrays, no torch, no sample by sample loading."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import Episode

UNKNOWN_TASK = "unknown"
_PICTURES = ("video", "image")


@dataclass(frozen=True)
class DatasetInfo:
    """What a dataset holds. success: episodes that succeeded at some step; None where no column says so."""

    root: Path
    robot: str
    task: str
    instruction: str
    fps: int
    episodes: int
    frames: int
    success: int | None
    success_at_end: int | None


def read_table(
    root: Path, columns: Sequence[str] | None = None, episodes: Sequence[int] | None = None
) -> dict[str, NDArray[Any]]:
    """Whole columns in stored order: (T,) for scalars, (T, d) for vectors; views of Arrow's memory, read-only.

    columns: all that are not pictures by default. episodes: indices of the episodes to keep; all by default.
    Raises `ManipError` for a folder that is no dataset or a file that cannot be read, `UnknownName` for a column
    that is not there, `UsageError` for an episode that is not there.
    """
    info = _read_info(root)
    table_features = {key: value for key, value in info["features"].items() if value["dtype"] not in _PICTURES}
    names = list(table_features) if columns is None else list(columns)
    for name in names:
        if name not in table_features:
            raise UnknownName(f"column in {root}", name, table_features)
    wanted = names if episodes is None else list(dict.fromkeys([*names, layout.EPISODE_INDEX]))
    table = pa.concat_tables(_read_file(path, wanted) for path in _data_files(root))
    if len(table) != info["total_frames"]:
        raise ManipError(f"{root}: {layout.INFO} counts {info['total_frames']} frames, its data files {len(table)}")
    if episodes is not None:
        table = _keep(root, table, episodes, info["total_episodes"])
    return {name: _to_numpy(table.column(name), table_features[name]["shape"]) for name in names}


def read_episodes(root: Path) -> Iterator[Episode]:
    """The dataset's episodes in order, scalars as (T, 1) columns; success as `next.success` has it.

    Raises what `read_table` raises.
    """
    shapes = {key: feature["shape"] for key, feature in s.features(read_spec(root)).items()}
    table = read_table(root, [*shapes, layout.EPISODE_INDEX])
    index = table.pop(layout.EPISODE_INDEX)
    starts = np.flatnonzero(np.diff(index, prepend=-1))
    for start, stop in zip(starts, [*starts[1:], len(index)], strict=True):
        columns = {key: values[start:stop].reshape(-1, *shapes[key]) for key, values in table.items()}
        success = columns[s.SUCCESS]
        yield Episode(int(columns[s.SEED].flat[0]), columns, bool(success.any()), bool(success[-1]))


def read_spec(root: Path) -> s.RobotTaskSpec:
    """The spec that the dataset was written with.

    LeRobot's tools drop our file beside theirs; then the spec comes from LeRobot's own, the task `unknown`.
    """
    ours = _read_ours(root)
    if ours:
        return s.RobotTaskSpec.from_json(ours["spec"])
    info = _read_info(root)
    try:
        return s.RobotTaskSpec(
            robot=str(info["robot_type"]),
            task=UNKNOWN_TASK,
            fps=int(info["fps"]),
            joint_names=tuple(info["features"][s.ACTION]["names"]),
            environment_state_names=tuple(info["features"][s.ENVIRONMENT_STATE]["names"]),
            sim_state_size=int(info["features"][s.SIM_STATE]["shape"][0]),
            instruction=_instruction(root),
        )
    except (KeyError, TypeError) as error:
        raise ManipError(f"{root} lacks columns that this project's datasets have: {error}") from error


def read_fingerprint(root: Path) -> dict[str, Any]:
    """The environment's fingerprint; empty for a dataset that another program wrote."""
    return _read_ours(root).get("fingerprint", {})


def read_provenance(root: Path) -> dict[str, Any]:
    """Where the episodes came from; empty for a dataset that another program wrote."""
    return _read_ours(root).get("provenance", {})


def dataset_info(root: Path) -> DatasetInfo:
    """Counts and names. Raises `ManipError` for a folder that is no dataset."""
    info = _read_info(root)
    ours = _read_ours(root)
    success = at_end = None
    if s.SUCCESS in info["features"]:
        columns = read_table(root, [s.SUCCESS, layout.EPISODE_INDEX])
        index, flags = columns[layout.EPISODE_INDEX], columns[s.SUCCESS].astype(bool)
        last = np.flatnonzero(np.diff(index, append=-1))
        success, at_end = len(np.unique(index[flags])), int(flags[last].sum())
    return DatasetInfo(
        root=root,
        robot=str(info["robot_type"]),
        task=ours["spec"]["task"] if ours else UNKNOWN_TASK,
        instruction=ours["spec"]["instruction"] if ours else _instruction(root),
        fps=int(info["fps"]),
        episodes=int(info["total_episodes"]),
        frames=int(info["total_frames"]),
        success=success,
        success_at_end=at_end,
    )


def camera_keys(root: Path) -> list[str]:
    """Names of the columns that are pictures."""
    return [key for key, value in _read_info(root)["features"].items() if value["dtype"] in _PICTURES]


def _read_info(root: Path) -> dict[str, Any]:
    path = root / layout.INFO
    if not path.is_file():
        raise ManipError(f"{root} is not a LeRobot dataset: it has no {layout.INFO}")
    info = _read_json(path)
    version = info.get("codebase_version")
    if version != layout.VERSION:
        raise ManipError(f"{root} is a dataset of version {version}; this program reads {layout.VERSION}")
    missing = {"fps", "features", "total_episodes", "total_frames", "robot_type"} - info.keys()
    if missing:
        raise ManipError(f"{path} lacks {', '.join(sorted(missing))}")
    return info


def _read_ours(root: Path) -> dict[str, Any]:
    path = root / layout.OURS
    if not path.is_file():
        _read_info(root)
        return {}
    ours = _read_json(path)
    if missing := {"spec", "fingerprint", "provenance"} - ours.keys():
        raise ManipError(f"{path} lacks {', '.join(sorted(missing))}")
    return ours


def _read_json(path: Path) -> dict[str, Any]:
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise ManipError(f"cannot read {path}: {error}") from error
    if not isinstance(data, dict):
        raise ManipError(f"{path} holds {type(data).__name__}; expected an object")
    return data


def _data_files(root: Path) -> list[Path]:
    paths = sorted(root.glob(layout.DATA_FILES))
    if not paths:
        raise ManipError(f"{root} has no data: no file matches {layout.DATA_FILES}")
    return paths


def _read_file(path: Path, columns: list[str]) -> pa.Table:
    try:
        # one thread: handing out pieces of one episode costs more than reading them
        table = pq.ParquetFile(path).read(columns, use_threads=False)
    except (OSError, pa.ArrowException) as error:
        raise ManipError(f"cannot read {path}: {error}; `manip-il doctor` tells what is left") from error
    for name in columns:
        if name not in table.column_names:
            raise UnknownName(f"column in {path}", name, table.column_names)
    return table.replace_schema_metadata(None)


def _keep(root: Path, table: pa.Table, episodes: Sequence[int], count: int) -> pa.Table:
    for episode in episodes:
        if not 0 <= episode < count:
            raise UsageError(f"{root} has no episode {episode}; it has 0 to {count - 1}")
    return table.filter(np.isin(table.column(layout.EPISODE_INDEX).to_numpy(), list(episodes)))


def _to_numpy(column: pa.ChunkedArray, shape: Sequence[int]) -> NDArray[Any]:
    array = column.combine_chunks()
    if isinstance(array, pa.ChunkedArray):  # what older versions give for no chunk at all
        array = pa.concat_arrays(array.chunks)
    length = len(array)
    if pa.types.is_fixed_size_list(array.type) or pa.types.is_list(array.type) or pa.types.is_large_list(array.type):
        return array.flatten().to_numpy(zero_copy_only=False).reshape(length, *shape)
    return array.to_numpy(zero_copy_only=False)


def _instruction(root: Path) -> str:
    tasks = _read_file(root / layout.TASKS, ["task"]).column("task").to_pylist()
    return tasks[0] if tasks else ""
