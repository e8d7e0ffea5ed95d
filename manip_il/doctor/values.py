"""Checks of numbers: finite, and as `meta/stats.json` says."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.data import lerobot_layout as layout
from manip_il.data.info import INDEX_FEATURES, NUMBERS, PICTURES, Feature
from manip_il.doctor.dataset import Dataset
from manip_il.doctor.finding import Finding, Remedy, error, plural, some, warning
from manip_il.doctor.moments import Moments
from manip_il.doctor.stored import stored

F64 = NDArray[np.float64]
# Shares of a column's largest absolute value. LeRobot's standard deviation is a difference of squares in float32,
# which leaves it the root of that precision.
_TOLERANCES = {"min": 1e-5, "max": 1e-5, "mean": 1e-4, "std": 2e-3}


def check_finite(dataset: Dataset) -> Iterator[Finding]:
    """Yield no NaN and no infinity in any column."""
    for key, moments in dataset.scan.moments.items():
        if moments.first_bad is not None:
            row, value = moments.first_bad
            like = plural(moments.bad_rows, "row")
            yield error(f"data: {key}", f"{value} in row {row:,} of the dataset ({like} like this)")


def check_statistics(dataset: Dataset) -> Iterator[Finding]:
    """`meta/stats.json` has the statistics of every column, and they are the data's."""
    info, stats = dataset.info, dataset.stats
    if info is None or info.episodes == 0:
        return
    if stats is None:
        state = "cannot be read" if (dataset.root / layout.STATS).exists() else "is missing"
        yield error(layout.STATS, f"{state}: nothing can be normalised with it", Remedy.STATISTICS)
        for feature in info.of_dtype(*PICTURES):
            yield error(f"{layout.STATS}: {feature.key}", "is missing")
        return
    if unknown := sorted(set(stats) - set(info.features)):
        yield warning(layout.STATS, f"has statistics of {some(unknown)}, which {layout.INFO} does not list")
    stale: list[str] = []
    for feature in info.of_dtype(*NUMBERS):
        if not dataset.reads_all_rows or feature.key not in dataset.scan.moments:
            continue
        findings = list(_compare(stats, feature, dataset.scan.moments[feature.key]))
        if findings and feature.key in INDEX_FEATURES:
            stale.append(feature.key)
        else:
            yield from findings
    if stale:
        what = f"statistics of {some(stale)} are not the data's"
        text = f"{what}; LeRobot's tools do not update them, and nothing needs them"
        yield warning(layout.STATS, text, Remedy.STATISTICS)
    for feature in info.of_dtype(*PICTURES):
        if not isinstance(stats.get(feature.key), dict):
            yield error(f"{layout.STATS}: {feature.key}", "is missing")
    yield from _ranks(dataset)


def _compare(stats: dict[str, Any], feature: Feature, moments: Moments) -> Iterator[Finding]:
    place = f"{layout.STATS}: {feature.key}"
    if moments.bad_rows or not moments.rows:
        return
    if not isinstance(stats.get(feature.key), dict):
        yield error(place, "is missing", Remedy.STATISTICS)
        return
    count = stored(stats, feature.key, "count")
    if count is None or count.tolist() != [moments.rows]:
        found = "nothing" if count is None else ", ".join(f"{value:g}" for value in count)
        yield error(place, f"count is {found}; the data has {plural(moments.rows, 'frame')}", Remedy.STATISTICS)
    mean = stored(stats, feature.key, "mean")
    of_last_axis = len(feature.shape) > 1 and mean is not None and mean.size == feature.shape[-1] != feature.size
    right = moments.over_last_axis(feature.shape) if of_last_axis else moments
    scale = np.maximum(np.abs(right.low), np.abs(right.high))
    wanted = {"min": right.low, "max": right.high, "mean": right.mean, "std": right.std}
    for name, values in wanted.items():
        yield from _differs(place, name, stored(stats, feature.key, name), values, _TOLERANCES[name] * scale)
    yield from _order(place, stats, feature, right, scale)


def _differs(place: str, name: str, found: F64 | None, wanted: F64, tolerance: F64) -> Iterator[Finding]:
    if found is None or len(found) != len(wanted):
        what = "no numbers" if found is None else plural(len(found), "number")
        yield error(place, f"{name} is {what}; expected {plural(len(wanted), 'number')}", Remedy.STATISTICS)
        return
    bad = np.flatnonzero(~(np.abs(found - wanted) <= tolerance + 1e-9))
    if len(bad):
        where = f"[{bad[0]}]" if len(wanted) > 1 else ""
        text = f"{name}{where} is {found[bad[0]]:.6g}; the data's is {wanted[bad[0]]:.6g}"
        like = f" ({len(bad)} of {len(wanted)} numbers like this)" if len(wanted) > 1 else ""
        yield error(place, text + like, Remedy.STATISTICS)


def _order(place: str, stats: dict[str, Any], feature: Feature, right: Moments, scale: F64) -> Iterator[Finding]:
    """LeRobot's quantiles of a dataset are means over its episodes', so that only their order is sure."""
    table = stats[feature.key]
    rows = [stored(stats, feature.key, name) for name in layout.QUANTILES]
    present = [row for row in rows if row is not None and len(row) == len(scale)]
    if present and (np.diff([right.low, *present, right.high], axis=0) < -1e-5 * scale - 1e-9).any():
        yield error(place, f"{', '.join(layout.QUANTILES)} are not in order between min and max", Remedy.STATISTICS)
    elif len(present) < len(rows) and any(name in table for name in layout.QUANTILES):
        yield error(place, f"{', '.join(layout.QUANTILES)} are not all there", Remedy.STATISTICS)


def _ranks(dataset: Dataset) -> Iterator[Finding]:
    """A quantile of ours is the value of rank ceil(q T): fewer than that are below it, at least that not above."""
    wrong: list[str] = []
    for key, moments in dataset.scan.moments.items():
        if moments.below is None or moments.up_to is None or moments.bad_rows:
            continue
        ranks = np.array([max(int(np.ceil(share * moments.rows)), 1) for share in layout.QUANTILES.values()])[:, None]
        if ((moments.below >= ranks) | (moments.up_to < ranks)).any():
            wrong.append(key)
    if wrong:
        text = f"quantiles of {some(wrong)} are not those of all frames (LeRobot averages them over episodes)"
        yield warning(layout.STATS, text, Remedy.STATISTICS)
