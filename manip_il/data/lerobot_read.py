"""Read LeRobot v3.0 datasets as whole columns: numpy arrays, no torch, no sample by sample loading."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.arrays import Allocate, in_memory
from manip_il.data.draws import read_drawn
from manip_il.data.frame_source import find_clips, to_part
from manip_il.data.info import LARGEST_META, PICTURES, info_problems, read_object
from manip_il.data.parquet_files import UNREADABLE, check_files, read_column, read_file, read_tasks
from manip_il.data.picture_columns import check_pictures
from manip_il.data.pictures import VideoReader, decode_cell
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.mdp import Episode

UNKNOWN_TASK = "unknown"
_INDEX = {"dtype": "int64", "shape": (1,)}


@dataclass(frozen=True)
class DatasetInfo:
    """Names and counts of a dataset. success: episodes that succeeded at some step; None where no column says so."""

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
    """Read whole columns in stored order: (T,) for scalars, (T, d) for vectors; views of Arrow's memory, read-only.

    columns: all that are not pictures by default. episodes: indices of the episodes to keep; all by default.
    Raises `ManipError` for a folder that is no dataset or a file that cannot be read, `UnknownName` for a column
    that is not there, `UsageError` for an episode that is not there.
    """
    info = _read_info(root)
    table_features = _number_features(info)
    names = list(table_features) if columns is None else list(columns)
    _check_known(root, names, table_features)
    wanted = names if episodes is None else list(dict.fromkeys([*names, layout.EPISODE_INDEX]))
    check_files(root, _data_files(root), wanted)
    table = pa.concat_tables(read_file(path, wanted) for path in _data_files(root))
    _check_rows(root, len(table))
    if episodes is not None:
        table = _keep(root, table, episodes, info["total_episodes"])
    return {name: read_column(root, name, table, table_features[name]) for name in names}


def read_tables(
    roots: Sequence[Path], columns: Sequence[str], allocate: Allocate = in_memory
) -> dict[str, NDArray[Any]]:
    """Read columns, (T,) or (T, d), of several datasets one after the other; frames and episodes are numbered on.

    One data file is held at a time, beside what `allocate` makes. Raises what `read_table` raises.
    """
    infos = [_read_info(root) for root in roots]
    total = sum(info["total_frames"] for info in infos)
    joined: dict[str, NDArray[Any]] = {}
    row = episode = 0
    for root, info in zip(roots, infos, strict=True):
        before = {layout.EPISODE_INDEX: episode, layout.INDEX: row}
        for piece in _pieces(root, info, list(columns)):
            for name, values in piece.items():
                if name not in joined:
                    joined[name] = allocate((total, *values.shape[1:]), _dtype(info["features"][name], values))
                part = joined[name][row : row + len(values)]
                part[:] = values.reshape(part.shape)
                if before.get(name):
                    part += before[name]
            row += len(next(iter(piece.values()), ()))
        episode += info["total_episodes"]
    return joined


def read_episodes(root: Path, *, pictures: bool = True) -> Iterator[Episode]:
    """Yield the dataset's episodes in order, scalars as (T, 1) columns, with pictures and their keypoints if wanted.

    An episode's success is what `next.success` has. One data file is held at a time. Raises what `read_table` and
    `read_frames` raise.
    """
    spec, tasks, drawn = read_spec(root), read_instructions(root), read_drawn(root)
    cameras = list(spec.image_keys) if pictures else []
    left_out = {} if pictures else spec.image_keys | spec.keypoint_keys
    wanted = {key: one for key, one in s.features(spec).items() if key not in left_out}
    shapes = {key: feature["shape"] for key, feature in wanted.items()}
    stored = [key for key in shapes if key not in cameras]
    _check_rows(root, sum(len(read_file(path, [layout.EPISODE_INDEX])) for path in _data_files(root)))
    info = _read_info(root)
    stills = [key for key in cameras if info["features"][key]["dtype"] == "image"]
    films = [key for key in cameras if key not in stills]
    clips = {key: find_clips(root, key, info["fps"]) for key in films}
    with ExitStack() as stack:
        readers = {key: stack.enter_context(closing(VideoReader())) for key in films}
        for path in _data_files(root):
            table = read_file(path, [*stored, *stills, layout.EPISODE_INDEX, layout.TASK_INDEX])
            columns = {key: read_column(root, key, table, wanted[key]).reshape(-1, *shapes[key]) for key in stored}
            index = read_column(root, layout.EPISODE_INDEX, table, _INDEX)
            task = read_column(root, layout.TASK_INDEX, table, _INDEX)
            starts = np.flatnonzero(np.diff(index, prepend=-1))
            for start, stop in zip(starts, [*starts[1:], len(index)], strict=True):
                own = {key: values[start:stop] for key, values in columns.items()}
                own |= {key: _decode(root, info, readers[key], clips[key], key, int(index[start])) for key in films}
                own |= {key: _stills(root, key, table.column(key)[start:stop]) for key in stills}
                text, draws = _text(root, tasks, int(task[start])), drawn.get(int(index[start]), {})
                yield _episode({key: own[key] for key in shapes}, text, draws)


def read_frames(root: Path, key: str, episode: int) -> NDArray[np.uint8]:
    """Return one camera's decoded frames of one episode, (T, height, width, 3). key: `observation.images.<camera>`.

    Raises `UnknownName` for a column that is no camera, `UsageError` for an episode that is not there, `ManipError`
    for a video file that cannot be read or lacks frames.
    """
    if key not in (known := camera_keys(root)):
        raise UnknownName(f"camera in {root}", key, known)
    info = _read_info(root)
    if info["features"][key]["dtype"] == "image":
        tables = (read_file(path, [key, layout.EPISODE_INDEX]) for path in _data_files(root))
        kept = [_keep(root, table, [episode], info["total_episodes"]) for table in tables]
        return _stills(root, key, pa.concat_tables(kept).column(key))
    with closing(VideoReader()) as reader:
        return _decode(root, info, reader, find_clips(root, key, info["fps"]), key, episode)


def read_spec(root: Path) -> s.RobotTaskSpec:
    """Return the spec that the dataset was written with.

    LeRobot's tools drop our file beside theirs; then the spec comes from LeRobot's own, the task `unknown`.
    """
    ours = _read_ours(root)
    if ours:
        return _spec(root, ours)
    info = _read_info(root)
    try:
        return s.RobotTaskSpec(
            **s.robot_of(str(info["robot_type"])),
            task=UNKNOWN_TASK,
            fps=int(info["fps"]),
            joint_names=tuple(info["features"][s.ACTION]["names"]),
            environment_state_names=tuple(info["features"][s.ENVIRONMENT_STATE]["names"]),
            sim_state_size=int(info["features"][s.SIM_STATE]["shape"][0]),
            instruction=_instruction(root),
            **_cameras(info),
        )
    except (KeyError, TypeError, IndexError) as error:
        raise ManipError(f"{root} lacks columns that this project's datasets have: {error}") from error


def read_fingerprint(root: Path) -> dict[str, Any]:
    """Return the environment's fingerprint; empty for a dataset that another program wrote."""
    return _read_ours(root).get("fingerprint", {})


def read_provenance(root: Path) -> dict[str, Any]:
    """Return where the episodes came from; empty for a dataset that another program wrote."""
    return _read_ours(root).get("provenance", {})


def dataset_info(root: Path) -> DatasetInfo:
    """Return counts and names. Raises `ManipError` for a folder that is no dataset."""
    info, ours = _read_info(root), _read_ours(root)
    spec = _spec(root, ours) if ours else None
    success = at_end = None
    if s.SUCCESS in info["features"]:
        columns = read_table(root, [s.SUCCESS, layout.EPISODE_INDEX])
        index, flags = columns[layout.EPISODE_INDEX], columns[s.SUCCESS].astype(bool)
        last = np.flatnonzero(np.diff(index, append=-1))
        success, at_end = len(np.unique(index[flags])), int(flags[last].sum())
    return DatasetInfo(
        root=root,
        robot=spec.robot if spec else s.robot_of(str(info["robot_type"]))["robot"],
        task=spec.task if spec else UNKNOWN_TASK,
        instruction=spec.instruction if spec else _instruction(root),
        fps=int(info["fps"]),
        episodes=int(info["total_episodes"]),
        frames=int(info["total_frames"]),
        success=success,
        success_at_end=at_end,
    )


def read_instructions(root: Path) -> dict[int, str]:
    """Return the text of every `task_index`. Raises `ManipError` where it cannot be read."""
    try:
        return dict(zip(*read_tasks(root), strict=True))
    except UNREADABLE as error:
        raise ManipError(
            f"cannot read {root / layout.TASKS}: {error}; run `manip-il doctor` to see what is left"
        ) from error


def camera_keys(root: Path) -> list[str]:
    """Return names of the columns that are pictures."""
    return [key for key, value in _read_info(root)["features"].items() if value["dtype"] in PICTURES]


def column_names(root: Path) -> list[str]:
    """Return names of all columns, pictures among them."""
    return list(_read_info(root)["features"])


def _spec(root: Path, ours: dict[str, Any]) -> s.RobotTaskSpec:
    try:
        return s.RobotTaskSpec.from_json(ours["spec"])
    except ManipError as error:
        raise ManipError(f"{root / layout.OURS}: {error}") from error


def check_dataset(root: Path) -> None:
    """Raise `ManipError` where another program must not be let read a dataset: for what its description or files say.

    Paths and names that lead out of its folder, what is no regular file, and parquet files that unpack to more than
    real ones do.
    """
    _read_info(root)
    for path in find_irregular(root):
        raise ManipError(f"{path} is not a regular file; a dataset holds no pipes, devices, sockets or broken links")
    for pattern in (layout.TASKS, layout.EPISODES_FILES, layout.DATA_FILES):
        check_files(root, sorted(root.glob(pattern)), None)


def check_all_pictures(root: Path) -> None:
    """Raise `ManipError` unless every picture of a dataset is in its files, as PNG or JPEG, and every film is an MP4.

    For a dataset that came from somewhere: readers of others, Hugging Face's and FFmpeg's, open what it names besides.
    """
    try:
        features = read_object(root / layout.INFO).get("features")
    except (OSError, ValueError):
        features = None  # no reader gets to its pictures
    declared = [key for key, one in features.items() if _dtype_of(one) == "image"] if isinstance(features, dict) else []
    for pattern in (layout.TASKS, layout.EPISODES_FILES, layout.DATA_FILES):
        for path in sorted(root.glob(pattern)):
            check_files(root, [path], declared)
            check_pictures(path, declared)
    for path in sorted(root.glob("videos/**/*.mp4")):
        with open(checks.open_regular(path), "rb") as file:
            if file.read(8)[4:] != b"ftyp":
                raise ManipError(f"{path} does not begin as an MP4 file does; FFmpeg would take it for another format")


def _dtype_of(feature: Any) -> Any:
    return cast(dict[str, Any], feature).get("dtype") if isinstance(feature, dict) else None


def find_irregular(root: Path) -> list[Path]:
    """Return what a folder holds besides files and folders: pipes, devices, sockets and links to nothing."""
    return sorted(path for path in root.rglob("*") if not (path.is_file() or path.is_dir()))


def _decode(
    root: Path, info: dict[str, Any], reader: VideoReader, clips: NDArray[np.int64], key: str, episode: int
) -> NDArray[np.uint8]:
    if not 0 <= episode < len(clips):
        raise UsageError(f"{root} has no episode {episode}; it has 0 to {len(clips) - 1}")
    part = to_part(clips[episode], key, info.get("video_path") or layout.VIDEO_PATH)
    return reader.read(root / part.path, part.first, part.count, int(info["fps"]))


def _stills(root: Path, key: str, column: pa.ChunkedArray) -> NDArray[np.uint8]:
    """Pictures of a data file's rows, (T, height, width, 3)."""
    try:
        return np.stack([decode_cell(one) for one in column.to_pylist()])
    except UNREADABLE as error:
        raise ManipError(f"cannot read the pictures {key} in {root}: {error}") from error


def _episode(columns: dict[str, NDArray[Any]], text: str, drawn: dict[str, Any]) -> Episode:
    seed, solved = int(columns[s.SEED].flat[0]), columns[s.SUCCESS]
    return Episode(seed, columns, bool(solved.any()), bool(solved[-1]), (), text, drawn)


def _cameras(info: dict[str, Any]) -> dict[str, Any]:
    """Cameras and their size for a spec, from LeRobot's feature table."""
    sizes: dict[str, tuple[int, int]] = {}
    for key, feature in info["features"].items():
        if feature["dtype"] in PICTURES and key.startswith(s.IMAGES):
            named = dict(zip(feature["names"], feature["shape"], strict=False))  # either order is about
            sizes[key.removeprefix(s.IMAGES)] = (int(named["height"]), int(named["width"]))
    if len(set(sizes.values())) > 1:
        raise ManipError(f"cameras of different sizes: {sizes}; this project's datasets have one size for all")
    video = not any(info["features"][s.IMAGES + camera]["dtype"] == "image" for camera in sizes)
    return {"cameras": tuple(sizes), "image_size": next(iter(sizes.values()), (0, 0)), "video": video}


def _pieces(root: Path, info: Mapping[str, Any], names: list[str]) -> Iterator[dict[str, NDArray[Any]]]:
    """Columns of one data file after the other. Raises what `read_table` raises, at the end for a wrong count."""
    known, found = _number_features(info), 0
    _check_known(root, names, known)
    check_files(root, _data_files(root), names)
    for path in _data_files(root):
        table = read_file(path, names)
        found += len(table)
        if found > info["total_frames"]:
            break
        yield {name: read_column(root, name, table, known[name]) for name in names}
    _check_rows(root, found)


def _number_features(info: Mapping[str, Any]) -> dict[str, Any]:
    return {key: value for key, value in info["features"].items() if value["dtype"] not in PICTURES}


def _check_known(root: Path, names: Iterable[str], known: Mapping[str, Any]) -> None:
    for name in names:
        if name not in known:
            raise UnknownName(f"column in {root}", name, known)


def _dtype(feature: Mapping[str, Any], values: NDArray[Any]) -> np.dtype[Any]:
    """The type of numbers that the dataset declares; its files may hold them narrower."""
    return values.dtype if values.dtype.kind == "O" else np.dtype(feature["dtype"])


def _check_rows(root: Path, found: int) -> None:
    frames = _read_info(root)["total_frames"]
    if found != frames:
        raise ManipError(f"{root}: {layout.INFO} counts {frames} frames, its data files {found}")


def _read_info(root: Path) -> dict[str, Any]:
    """Stricter than `info.read_info`, which the doctor lists all problems of: no NaN, and `robot_type` is there."""
    path = root / layout.INFO
    if not path.exists():
        raise ManipError(f"{root} is not a LeRobot dataset: it has no {layout.INFO}")
    info = checks.read_json(path, "a LeRobot dataset's description", LARGEST_META)
    version = info.get("codebase_version")
    if version != layout.VERSION:
        found = version if isinstance(version, str) and len(version) < 20 else checks.shorten(version)
        raise ManipError(f"{root} is a dataset of version {found}; this program reads {layout.VERSION}")
    missing = {"fps", "features", "total_episodes", "total_frames", "robot_type"} - info.keys()
    if missing:
        raise ManipError(f"{path} lacks {', '.join(sorted(missing))}")
    for problem in info_problems(info):
        raise ManipError(f"{path}: {problem}")
    return info


def _read_ours(root: Path) -> dict[str, Any]:
    path = root / layout.OURS
    if not path.exists():
        _read_info(root)
        return {}
    ours = checks.read_json(path, "what this program says of its datasets", LARGEST_META)
    if missing := {"spec", "fingerprint", "provenance"} - ours.keys():
        raise ManipError(f"{path} lacks {', '.join(sorted(missing))}")
    for key in ("spec", "fingerprint", "provenance"):
        checks.mapping(f"{path}: {key}", ours[key])
    return ours


def _data_files(root: Path) -> list[Path]:
    paths = sorted(root.glob(layout.DATA_FILES))
    if not paths:
        raise ManipError(f"{root} has no data: no file matches {layout.DATA_FILES}")
    return paths


def _keep(root: Path, table: pa.Table, episodes: Sequence[int], count: int) -> pa.Table:
    for episode in episodes:
        if not 0 <= episode < count:
            raise UsageError(f"{root} has no episode {episode}; it has 0 to {count - 1}")
    return table.filter(np.isin(table.column(layout.EPISODE_INDEX).to_numpy(), list(episodes)))


def _text(root: Path, tasks: dict[int, str], number: int) -> str:
    if not isinstance(text := tasks.get(number), str):
        raise ManipError(f"{root}: rows have the task {number}, which {layout.TASKS} does not hold as text")
    return text


def _instruction(root: Path) -> str:
    tasks = read_file(root / layout.TASKS, ["task"]).column("task").to_pylist()
    return tasks[0] if tasks else ""
