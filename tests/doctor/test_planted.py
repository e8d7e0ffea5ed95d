"""Fifteen kinds of defects, planted into twenty datasets of this program and of LeRobot: found, and nothing else."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.doctor import examine
from manip_il.doctor.examine import examine_folder

from ..damage import DATA, EPISODES, cut, edit_json, edit_table
from ..pictures import encoded
from .teaching import EPISODES as COUNT
from .teaching import encode, make

Plant = Callable[[Path, np.random.Generator], tuple[str, str]]  # returns place and text of the finding


def motion(root: Path, change: Callable[[np.ndarray, np.ndarray, int], None], episodes: Any = range(COUNT)) -> None:
    """Change state and action, (T, 5) each, of some episodes in place; statistics follow."""
    table = pq.read_table(root / DATA)
    columns = {key: np.array(table[key].to_pylist(), np.float32) for key in (s.STATE, s.ACTION)}
    number = table[layout.EPISODE_INDEX].to_numpy()
    for episode in episodes:
        rows = np.flatnonzero(number == episode)
        change(columns[s.STATE][rows[0] : rows[-1] + 1], columns[s.ACTION][rows[0] : rows[-1] + 1], episode)
    store(root, columns)


def store(root: Path, columns: dict[str, np.ndarray]) -> None:
    table, stats = pq.read_table(root / DATA), json.loads((root / layout.STATS).read_text())
    for key, values in columns.items():
        place = table.schema.get_field_index(key)
        cells = pa.array(values.tolist(), table.schema.field(key).type)
        table = table.set_column(place, table.schema.field(key), cells)
        for name in ("min", "max", "mean", "std"):
            stats[key][name] = getattr(np, name)(values.astype(float), axis=0).reshape(-1).tolist()
    pq.write_table(table, root / DATA)
    (root / layout.STATS).write_text(json.dumps(stats))


def some(rng: np.random.Generator, share: int = 4) -> list[int]:
    return sorted(rng.choice(COUNT, COUNT // share, replace=False).tolist())


def counts(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    key = str(rng.choice(["total_episodes", "total_frames", "total_tasks"]))
    edit_json(root / layout.INFO, lambda info: info.update({key: info[key] + int(rng.choice([-1, 1, 5]))}))
    return layout.INFO, "frames" if key == "total_frames" else key


def rows(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    key = str(rng.choice(["length", "dataset_from_index", "episode_index"]))
    row = int(rng.integers(1, COUNT))
    edit_table(root / EPISODES, lambda table: table[key].__setitem__(row, table[key][row] + 3))
    return "meta/episodes", "expected"


def names(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    key = next(iter(Dataset.open(root).cameras), s.ACTION)
    wrong = (
        [None, ["width", "height", "channels"], ["channels", "height", "width"]] if key != s.ACTION else [["a", "b"]]
    )
    edit_json(root / layout.INFO, lambda info: info["features"][key].update(names=wrong[rng.integers(len(wrong))]))
    return layout.INFO, "names"


def frames(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    """A camera's pictures missing or of another size; without cameras, rows missing."""
    dataset = Dataset.open(root)
    if not dataset.cameras:
        pq.write_table(pq.read_table(root / DATA).slice(0, len(dataset) - int(rng.integers(1, 20))), root / DATA)
        return layout.INFO, "data files"
    key = str(rng.choice(dataset.cameras))
    if dataset.features[key].dtype == "image":
        picture = {"bytes": encoded(np.zeros((48, 48, 3), np.uint8)), "path": None}
        edit_table(root / DATA, lambda table: table[key].__setitem__(int(rng.integers(10)) * 0, picture))
        return key, "shape"
    pictures = dataset.frames(key, np.arange(len(dataset)))
    if rng.random() < 0.5:
        encode(root, key, pictures[: -int(rng.integers(1, 20))], dataset.fps)
        return "videos", "frames"
    encode(root, key, pictures[:, :40], dataset.fps)
    return key, "shape"


def finite(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    key, row = str(rng.choice([s.STATE, s.ACTION])), int(rng.integers(100))
    value = float(rng.choice([np.nan, np.inf, -np.inf]))
    edit_table(root / DATA, lambda table: table[key].__setitem__(row, [value] * 5))
    return f"data: {key}", f"row {row}"


def times(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    scale = float(rng.choice([0.5, 0.97, 1.1]))
    store(root, {layout.TIMESTAMP: pq.read_table(root / DATA)[layout.TIMESTAMP].to_numpy() * scale})
    return "timestamp", "expected"


def statistics(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    key, name = str(rng.choice([s.STATE, s.ACTION])), str(rng.choice(["min", "max", "mean", "std"]))
    edit_json(root / layout.STATS, lambda stats: stats[key][name].__setitem__(2, stats[key][name][2] + 0.05))
    return f"stats.json: {key}", f"{name} is"


def died(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    if rng.random() < 0.5:
        name = str(rng.choice([DATA, EPISODES]))
        cut(root / name, float(rng.uniform(0.3, 0.95)))
        return name, "recorder had died" if name == DATA else "no footer"
    left = str(rng.choice(["images/front/episode-000003/frame-000000.png", "tmpab12cd_9/x.mp4", "meta/.x.partial"]))
    (root / left).parent.mkdir(parents=True, exist_ok=True)
    (root / left).write_bytes(b"x")
    return left.split("/")[0], "died"


def tasks(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    if rng.random() < 0.5:
        store(root, {layout.TASK_INDEX: np.full(len(Dataset.open(root)), 3)})
        return "task_index", "3"
    edit_table(root / EPISODES, lambda table: table["tasks"].__setitem__(0, ["Drop it"]))
    return "tasks", "Drop it"


def own(root: Path, rng: np.random.Generator) -> tuple[str, str] | None:
    if not (root / layout.OURS).exists():
        return None
    key = str(rng.choice([s.LABEL_VALID, s.ACTOR, s.SEED, "spec"]))
    if key == "spec":
        edit_json(root / layout.OURS, lambda ours: ours["spec"]["joint_names"].__setitem__(0, "other"))
        return layout.INFO, "says"
    edit_table(root / DATA, lambda table: table[key].__setitem__(9, 77))
    return f"data: {key}", "77"


def idle(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    def change(state: np.ndarray, action: np.ndarray, episode: int) -> None:
        stop = int(rng.uniform(0.55, 0.8) * len(state))
        state[:stop], action[:stop] = state[0], action[0]

    motion(root, change, some(rng, 2))
    return s.ACTION, "nothing moves"


def lag(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    frames, fps = int(rng.integers(3, 6)), Dataset.open(root).fps
    early = rng.random() < 0.4
    frames = -round(0.45 * fps) if early else frames

    def change(state: np.ndarray, action: np.ndarray, episode: int) -> None:
        action[:] = action[(np.arange(len(action)) - frames).clip(0, len(action) - 1)]

    motion(root, change)
    return s.ACTION, "lead the joints" if early else "lag the joints"


def cameras(root: Path, rng: np.random.Generator) -> tuple[str, str] | None:
    """Frozen, black or swapped in some episodes."""
    dataset, odd, what = Dataset.open(root), some(rng), str(rng.choice(["stands still", "is black", "swapped"]))
    if not dataset.cameras:
        return None
    row = np.arange(len(dataset))
    seen = {key: dataset.frames(key, row).copy() for key in dataset.cameras}
    left, right = seen.values()
    for part in map(dataset.rows_of, odd):
        if what == "swapped":
            left[part], right[part] = right[part].copy(), left[part].copy()
        else:
            left[part] = left[part[0]] if what == "stands still" else rng.integers(0, 8, left[part].shape, np.uint8)
    for key, pictures in seen.items():
        if dataset.features[key].dtype == "image":
            cells = [{"bytes": encoded(one), "path": None} for one in pictures]
            edit_table(root / DATA, lambda table, key=key, cells=cells: table.__setitem__(key, cells))
        else:
            encode(root, key, pictures, dataset.fps)
    return dataset.cameras[0], what


def joint(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    """Another zero or sign, of the state alone or of the action, too."""
    place, sign, both = int(rng.integers(4)), rng.random() < 0.5, rng.random() < 0.5
    offset = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0))

    def change(state: np.ndarray, action: np.ndarray, episode: int) -> None:
        for values in (state, action)[: 1 + both]:
            values[:, place] = -values[:, place] if sign else values[:, place] + offset

    motion(root, change, some(rng))
    return s.STATE, "zero or sign"


def commands(root: Path, rng: np.random.Generator) -> tuple[str, str]:
    """A gripper that does not follow, actions cut off, or one text for two motions."""
    what = str(rng.choice(["never reached", "cut off", "another way"]))
    half, stuck, place, limit = (
        set(some(rng, 3)),
        rng.random() < 0.5,
        int(rng.integers(4)),
        float(rng.uniform(0.6, 0.8)),
    )

    def change(state: np.ndarray, action: np.ndarray, episode: int) -> None:
        if what == "never reached":
            state[:, 4] = 0.04 + (state[:, 4] - 0.04) * (0.0 if stuck else 0.4)
        elif what == "cut off":
            column = action[:, place]
            way = np.sign(column[len(column) // 2] - column[0])
            action[:, place] = way * np.minimum(way * column, bound[way])
        elif episode in half:
            for values in (state, action):
                values[:, :4] = 2 * values[0, :4] - values[:, :4]

    table = np.array(pq.read_table(root / DATA)[s.ACTION].to_pylist())[:, place]
    bound = {way: np.quantile(way * table, limit) for way in (-1, 1)}
    motion(root, change)
    return "task" if what == "another way" else s.ACTION, what


PLANTS: tuple[Plant, ...] = (counts, rows, names, frames, finite, times, statistics, died, tasks, own)
PLANTS += (idle, lag, cameras, joint, commands)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("made")
    return [make(folder / f"set{number:02d}", number) for number in range(20)]


@pytest.fixture(autouse=True)
def no_child(monkeypatch: pytest.MonkeyPatch) -> None:
    """A process for each examination would take most of the time; others test it."""
    monkeypatch.setattr(examine, "check_arrived", lambda root, strict: None)


def test_no_false_alarms(made):
    assert [(root.name, str(finding)) for root in made for finding in examine_folder(root)] == []


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
def test_planted_defects_are_found(made, tmp_path, plant):
    missed: list[str] = []
    planted = 0
    for number, root in enumerate(made):
        copy = shutil.copytree(root, tmp_path / root.name)
        wanted = plant(copy, np.random.default_rng(number))
        if wanted is None:
            continue
        planted += 1
        found = examine_folder(copy)
        if not any(wanted[0] in one.place and wanted[1] in f"{one.place} {one.text}" for one in found):
            missed.append(f"{root.name}: {wanted}: {[str(one)[:200] for one in found]}")
    print(f"{plant.__name__}: {planted - len(missed)} of {planted}")
    assert len(missed) <= 0.05 * planted, "\n".join(missed)
