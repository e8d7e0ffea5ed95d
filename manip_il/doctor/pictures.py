"""Checks of cameras stored as pictures in the data files: every one can be decoded and has the right size."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from manip_il.data import lerobot_layout as layout
from manip_il.data.pictures import open_picture
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, error, plural
from manip_il.doctor.info import Feature
from manip_il.doctor.pixels import Brightness, check_brightness
from manip_il.doctor.shards import UNREADABLE, Shard

_BATCH = 64  # pictures held at once
_SAMPLE = 20  # of so many, one is looked at


def check_pictures(dataset: Dataset) -> Iterator[Finding]:
    """Decode every picture that stands in a data file."""
    if dataset.info is None:
        return
    for feature in dataset.info.of_dtype("image"):
        brightness = Brightness()
        for shard in dataset.data_shards:
            if not shard.problem and feature.key in shard.columns:
                yield from _check_shard(shard, feature, brightness)
                dataset.on_file()
        yield from check_brightness(dataset, feature, brightness)


def _check_shard(shard: Shard, feature: Feature, brightness: Brightness) -> Iterator[Finding]:
    place = f"{shard.name}: {feature.key}"
    bad: list[tuple[int, str]] = []
    row = 0
    try:
        for batch in shard.batches(feature.key, _BATCH):
            for cell in batch.to_pylist():
                if problem := _problem(cell, feature, brightness if row % _SAMPLE == 0 else None):
                    bad.append((row, problem))
                row += 1
    except UNREADABLE as problem:
        yield error(place, f"cannot be read: {problem}")
    if bad:
        yield error(place, f"the picture in row {bad[0][0]:,} {bad[0][1]} ({plural(len(bad), 'row')} like this)")


def _problem(cell: Any, feature: Feature, brightness: Brightness | None) -> str:
    """What is wrong with one picture; empty for nothing."""
    data = cell.get("bytes") if isinstance(cell, dict) else None
    if not isinstance(data, bytes):
        return "is not in the file"
    try:
        with open_picture(data) as picture:
            picture.load()
            size = picture.height, picture.width
            if brightness is not None and feature.channels == 3:
                brightness.add(np.asarray(picture.convert("RGB")))
    except Exception as problem:  # what damaged bytes make of a decoder, nobody lists
        return f"cannot be decoded: {problem or type(problem).__name__}"
    if size != feature.picture_size:
        found, wanted = (f"{height} x {width}" for height, width in (size, feature.picture_size))
        return f"is {found} (height x width); {layout.INFO} says {wanted}"
    return ""
