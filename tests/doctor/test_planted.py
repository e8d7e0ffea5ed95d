"""Fifteen kinds of defects, planted into twenty datasets of this program and of LeRobot: found,
and nothing else.
"""

import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.parquet as pq
import pytest

from manip_il.bridges.doctor.examine import examine_folder
from manip_il.data import lerobot_layout as layout
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset

from ..damage import DATA, EPISODES, cut, edit_json, edit_table
from ..pictures import encoded
from .teaching import EPISODES as COUNT
from .teaching import encode, make

Rng = np.random.Generator
Plant = Callable[[Path, Rng], str | None]  # returns a pattern of the finding's line


def move(
    root: Path, change: Callable[[np.ndarray, np.ndarray], None], episodes: Any = range(COUNT)
) -> None:
    """Change state and action, (T, 5) each, of these episodes in place."""
    dataset = Dataset.open(root)
    columns = {key: values.copy() for key, values in dataset.columns([s.STATE, s.ACTION]).items()}
    for rows in map(dataset.rows_of, episodes):
        change(*(columns[key][rows[0] : rows[-1] + 1] for key in (s.STATE, s.ACTION)))
    edit_table(
        root / DATA, lambda table: table.update({key: one.tolist() for key, one in columns.items()})
    )


def some(rng: Rng, share: int = 4) -> list[int]:
    return sorted(rng.choice(COUNT, COUNT // share, replace=False).tolist())


def show(root: Path, pictures: dict[str, np.ndarray]) -> None:
    """Write a camera's pictures anew."""
    for key, ones in pictures.items():
        if Dataset.open(root).features[key].dtype == "video":
            encode(root, key, ones, Dataset.open(root).fps)
            continue
        cells = [{"bytes": encoded(one), "path": None} for one in ones]
        edit_table(root / DATA, lambda table, key=key, cells=cells: table.update({key: cells}))


def counts(root: Path, rng: Rng) -> str:
    key = str(rng.choice(["total_episodes", "total_frames", "total_tasks"]))
    edit_json(
        root / layout.INFO, lambda info: info.update({key: info[key] + int(rng.choice([-1, 1, 5]))})
    )
    return r"meta/info.json.*(counts \d+ frames|total_(episodes|tasks): \d+; expected)"


def rows(root: Path, rng: Rng) -> str:
    key, row = (
        str(rng.choice(["length", "dataset_from_index", "episode_index"])),
        int(rng.integers(1, COUNT)),
    )
    edit_table(root / EPISODES, lambda table: table[key].__setitem__(row, table[key][row] + 3))
    return "meta/episodes: .*; expected"


def names(root: Path, rng: Rng) -> str | None:
    wrong = [None, ["width", "height", "channels"], ["channels", "height", "width"]][
        rng.integers(3)
    ]
    for key in Dataset.open(root).cameras:
        edit_json(
            root / layout.INFO, lambda info, key=key: info["features"][key].update(names=wrong)
        )
        return f"error    meta/info.json: {key}: .* LeRobot cannot train; set .*channels"
    return None


def frames(root: Path, rng: Rng) -> str:
    """A camera's pictures missing or of another size; without cameras, rows missing."""
    dataset, lost = Dataset.open(root), int(rng.integers(1, 20))
    for key in dataset.cameras:
        pictures, fewer = dataset.frames(key, np.arange(len(dataset))), rng.random() < 0.5
        if fewer and dataset.features[key].dtype == "image":
            edit_table(
                root / DATA,
                lambda table, key=key: table[key].__setitem__(lost, {"bytes": None, "path": None}),
            )
            return f"{DATA}: {key}: 1 of .* rows have no picture"
        show(root, {key: pictures[:-lost] if fewer else pictures[:, :40]})
        return (
            r"videos/.*: \d+ frames for \d+ rows"
            if fewer
            else r".*pictures are 40 x 64; expected 48 x 64"
        )
    pq.write_table(pq.read_table(root / DATA).slice(0, len(dataset) - lost), root / DATA)
    return r"meta/info.json.*counts \d+ frames, its data files \d+"


def finite(root: Path, rng: Rng) -> str:
    key, row, value = (
        str(rng.choice([s.STATE, s.ACTION])),
        int(rng.integers(100)),
        rng.choice([np.nan, np.inf]),
    )
    edit_table(root / DATA, lambda table: table[key].__setitem__(row, [float(value)] * 5))
    return f"data: {key}: not finite in row {row} "


def times(root: Path, rng: Rng) -> str:
    scale = float(rng.choice([0.5, 0.97, 1.1]))
    edit_table(
        root / DATA,
        lambda table: table.update(timestamp=[time * scale for time in table["timestamp"]]),
    )
    return r"data: timestamp at \d+ frames per second: .*; expected"


def statistics(root: Path, rng: Rng) -> str:
    key, name = str(rng.choice([s.STATE, s.ACTION])), str(rng.choice(["min", "max", "mean", "std"]))
    edit_json(
        root / layout.STATS,
        lambda stats: stats[key][name].__setitem__(2, stats[key][name][2] + 0.05),
    )
    return f"stats.json: {key}: {name} is .*expected"


def died(root: Path, rng: Rng) -> str:
    name = str(rng.choice([DATA, EPISODES]))
    cut(root / name, float(rng.uniform(0.3, 0.95)))
    return f"{name}: "


def tasks(root: Path, rng: Rng) -> str:
    if rng.random() < 0.5:
        edit_table(root / DATA, lambda table: table[layout.TASK_INDEX].__setitem__(9, 3))
        return "data: task_index: 3 at 9; expected 0"
    edit_table(root / EPISODES, lambda table: table["tasks"].__setitem__(0, ["Drop it"]))
    return "meta/episodes: tasks: .*Drop it"


def idle(root: Path, rng: Rng) -> str:
    def change(*both: np.ndarray) -> None:
        for values in both:
            values[: int(0.7 * len(values))] = values[0]

    move(root, change, some(rng, 2))
    return "action: nothing moves for seconds, in [1-9]"


def lag(root: Path, rng: Rng) -> str:
    early = rng.random() < 0.4
    late = -round(0.45 * Dataset.open(root).fps) if early else int(rng.integers(3, 6))

    def change(state: np.ndarray, action: np.ndarray) -> None:
        action[:] = action[(np.arange(len(action)) - late).clip(0, len(action) - 1)]

    move(root, change)
    return f"action: actions {'lead' if early else 'lag'} the joints by [1-9]"


def cameras(root: Path, rng: Rng) -> str | None:
    """Frozen, black or swapped in some episodes."""
    dataset, what = (
        Dataset.open(root),
        str(rng.choice(["is frozen", "is black", "is swapped with"])),
    )
    if not dataset.cameras:
        return None
    seen = {key: dataset.frames(key, np.arange(len(dataset))).copy() for key in dataset.cameras}
    left, right = seen.values()
    for part in map(dataset.rows_of, some(rng)):
        if what == "is swapped with":
            left[part], right[part] = right[part].copy(), left[part].copy()
        else:
            left[part] = (
                left[part[0]]
                if what == "is frozen"
                else rng.integers(0, 8, left[part].shape, np.uint8)
            )
    show(root, seen)
    return f"{dataset.cameras[0]}: {what} .*3 of 12 episodes"


def joint(root: Path, rng: Rng) -> str:
    """Another zero or sign, of the state alone or of the action, too."""
    place, sign, both = int(rng.integers(4)), rng.random() < 0.5, rng.random() < 0.5
    offset = float(rng.choice([-1, 1]) * rng.uniform(0.3, 1.0))

    def change(*both_columns: np.ndarray) -> None:
        for values in both_columns[: 1 + both]:
            values[:, place] = -values[:, place] if sign else values[:, place] + offset

    move(root, change, some(rng))
    return "observation.state: .*its zero or sign differs"


def commands(root: Path, rng: Rng) -> str:
    """A gripper that does not follow."""
    follows = float(rng.choice([0.0, 0.4]))

    def change(state: np.ndarray, action: np.ndarray) -> None:
        state[:, 4] = 0.04 + (state[:, 4] - 0.04) * follows

    move(root, change)
    return "action: .*but only moves"


def wraps(root: Path, rng: Rng) -> str:
    """A joint in degrees or radians that passes the end of its turn."""
    place, half = int(rng.integers(4)), float(rng.choice([180.0, np.pi]))

    def change(*both: np.ndarray) -> None:
        for values in both:
            values[:, place] = (half * np.linspace(1.9, 2.1, len(values))) % (2 * half) - half

    move(root, change, chosen := some(rng))
    return (
        rf"observation.state: .* jump by a turn at .* \(episodes {', '.join(map(str, chosen))}\):"
        r" relative actions"
    )


PLANTS: tuple[Plant, ...] = (
    *(counts, rows, names, frames, finite, times, statistics, died, tasks),
    *(idle, lag, cameras, joint, commands, wraps),
)


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    folder = tmp_path_factory.mktemp("made")
    return [make(folder / f"set{number:02d}", number) for number in range(10)]


def test_no_false_alarms(made):
    assert [(root.name, str(finding)) for root in made for finding in examine_folder(root)] == []


@pytest.mark.parametrize("plant", PLANTS, ids=lambda plant: plant.__name__)
def test_planted_defects_are_found(made, tmp_path, plant):
    missed: list[str] = []
    planted = 0
    for number, root in enumerate(made):
        copy = shutil.copytree(root, tmp_path / root.name)
        if (wanted := plant(copy, np.random.default_rng(number))) is not None:
            planted += 1
            lines = [str(one) for one in examine_folder(copy)]
            missed += (
                []
                if any(re.search(wanted, line) for line in lines)
                else [f"{root.name}: {wanted}: {lines}"]
            )
    print(f"{plant.__name__}: {planted - len(missed)} of {planted}")
    assert len(missed) <= 0.05 * planted, "\n".join(missed)
