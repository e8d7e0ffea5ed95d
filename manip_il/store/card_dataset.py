"""The card of a dataset."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import numpy as np
from huggingface_hub import DatasetCardData

from manip_il.data import schema as s
from manip_il.data.lerobot_layout import DATA_FILES
from manip_il.data.lerobot_read import (
    UNKNOWN_TASK,
    DatasetInfo,
    camera_keys,
    dataset_info,
    read_fingerprint,
    read_provenance,
    read_table,
)
from manip_il.errors import UnknownName
from manip_il.store.card_text import LICENSE, command, fingerprint_rows, repository, table

_SIZES = ((10**3, "n<1K"), (10**4, "1K<n<10K"), (10**5, "10K<n<100K"), (10**6, "100K<n<1M"), (10**7, "1M<n<10M"))
_UNITS = ((3600, "hours"), (60, "minutes"), (1, "seconds"))
_SOURCES = 20  # of a merged dataset: as many are named
_DRIVERS = {"expert": "the expert", "noisy_expert": "the expert with noise", "policy": "the learner"}


def dataset_card(root: Path, url: str, picture: str | None) -> str:
    """`README.md`. picture: its path in the repository."""
    info, place = dataset_info(root), repository(url)
    name = f"{info.robot} {info.task}" if info.task != UNKNOWN_TASK else place
    shown = f"![Some of its episodes]({picture})\n\n" if picture else ""
    made = "\n".join(f"- {line}" for line in _provenance(read_provenance(root)))
    return (
        f"---\n{_metadata(info).to_yaml()}\n---\n\n# {name}\n\n{info.instruction}\n\n{shown}"
        f"{table(_rows(root, info))}\n\n"
        f"A [LeRobot](https://github.com/huggingface/lerobot) v3.0 dataset. {_labels(root)}\n\n"
        f"## Use\n\n```python\nfrom lerobot.datasets.lerobot_dataset import LeRobotDataset\n\n"
        f'dataset = LeRobotDataset("{place}")\n```\n\n'
        f"```sh\nmanip-il pull hf://datasets/{place} datasets/{place.rpartition('/')[2]}\n"
        f"lerobot-train --dataset.repo_id={place} \\\n  --policy.type=act --policy.push_to_hub=false\n```\n\n"
        f"## How it was made\n\n{made}\n\n{_command(root)}{fingerprint_rows(read_fingerprint(root))}"
    )


def _metadata(info: DatasetInfo) -> DatasetCardData:
    size = next((name for most, name in _SIZES if info.frames < most), "n>10M")
    tags = dict.fromkeys(["LeRobot", "robotics", "manip_il", info.robot, info.task])
    return DatasetCardData(
        license=LICENSE,
        task_categories=["robotics"],
        size_categories=[size],
        tags=[tag for tag in tags if tag not in (UNKNOWN_TASK, "None", "")],
        configs=[{"config_name": "default", "data_files": DATA_FILES}],
    )


def _rows(root: Path, info: DatasetInfo) -> Iterator[tuple[str, object]]:
    seconds = info.frames / info.fps
    unit, name = next((unit, name) for unit, name in _UNITS if seconds >= unit or unit == 1)
    time = f"{seconds / unit:.3g} {name}"
    yield "robot", f"`{info.robot}`"
    yield "task", f"`{info.task}`: {info.instruction}"
    cameras = [key.removeprefix(s.IMAGES) for key in camera_keys(root)]
    yield "cameras", ", ".join(f"`{name}`" for name in cameras) or "none: states only"
    yield "episodes", f"{info.episodes:,}"
    yield "frames", f"{info.frames:,} at {info.fps} a second, {time}"
    if info.success is not None:
        yield "success", f"{info.success:,} of {info.episodes:,} episodes"
    if seeds := _seeds(root):
        yield "seeds", seeds


def _seeds(root: Path) -> str:
    try:
        seeds = np.unique(read_table(root, [s.SEED])[s.SEED])
    except UnknownName:
        return ""
    return f"{len(seeds):,}, from {seeds[0]} to {seeds[-1]}" if len(seeds) > 1 else f"{seeds[0]}"


def _labels(root: Path) -> str:
    try:
        read_table(root, [s.EXECUTED_ACTION, s.LABEL_VALID], [0])
    except UnknownName:
        return ""
    return (
        "Every frame holds two actions: `action` is what the expert would have done there, `executed_action` what "
        "drove the robot, and `actor` who that was. Train on frames whose `label_valid` is 1."
    )


def _provenance(one: Mapping[str, Any], name: str = "") -> Iterator[str]:
    """One line a source, whatever another program wrote there."""
    if not one:
        yield "The origin of its episodes is unknown."
        return
    sources = one.get("merged") or one.get("sources")
    if isinstance(sources, list):
        yield f"Joined from {len(sources)} datasets" + (", among them:" if len(sources) > _SOURCES else ":")
        for source in sources[:_SOURCES]:
            if isinstance(source, dict):
                inner = source.get("provenance")
                yield from _provenance(inner if isinstance(inner, dict) else {}, Path(str(source.get("name", ""))).name)
        return
    driver = str(one.get("driver", "somebody"))
    words = [
        f"{_DRIVERS.get(driver, driver)} drove",
        *(f"{key} {one[key]:g}" for key in ("round", "beta") if key in one),
    ]
    seeds = one.get("seeds")
    if isinstance(seeds, list) and len(seeds) == 2:
        words.append(f"seeds {seeds[0]} to {seeds[1]}")
    if "tried" in one:
        words.append(f"{one['tried']} episodes tried")
    yield (f"`{name}`: " if name not in ("", "dataset") else "") + ", ".join(words)


def _command(root: Path) -> str:
    """From the options that were kept beside the journals, or of the run that the dataset is part of."""
    root = root.absolute()
    places = (root.with_name(f"{root.name}.journals") / "config.yaml", root.parent / "config.yaml")
    text = next((found for found in map(command, places) if found), None)
    return f"```sh\n{text}\n```\n\n" if text else ""
