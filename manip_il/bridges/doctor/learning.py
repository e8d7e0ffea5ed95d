"""Why a policy may not learn from a dataset: warnings about its motions and cameras, with numbers.

Motions are checked in episodes driven by a teacher; if a learner drives, actions are labels that
were not executed.
"""

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.bridges.doctor.files import Finding, list_first, of_episodes, warning
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.mdp import F64, Actor

Mask = NDArray[np.bool_]
Rows = dict[int, slice]  # episode -> its rows
_GRIPPER = re.compile(r"grip|finger|jaw|hand|claw", re.IGNORECASE)
_STILL = 0.01  # a joint is still if it moves by less than this share of its range within a second
_IDLE = 0.1  # tolerated share of the frames
_LEAD = 0.4  # tolerated lead of actions over the joints that follow them [s]
_LEAST = 10  # least number of episodes for comparisons between them
# checked episodes, pictures of each, thumbnail size [pixels]
_EPISODES = 100
_PICTURES = 6
_SIZE = (16, 16)
_HALF_TURNS = (180.0, np.pi)  # [deg], [rad]
# pixel values, 0 to 255: largest change in an unchanged thumbnail, mean of a black picture
_SAME = 1.5
_DARK = 10.0
_AGAIN = "correct the recorder, and record again"


def check_motions(dataset: Dataset) -> Iterator[Finding]:
    """Check for idle time, wrapping joints, lagging actions, changed zeros, unreached commands."""
    names = (s.STATE, s.ACTION)
    features = [dataset.features[key] for key in names if key in dataset.features]
    if [len(feature.shape) for feature in features if feature.dtype in NUMBERS] != [1, 1]:
        return
    state, action = (dataset.columns([key])[key].reshape(len(dataset), -1) for key in names)
    both = np.hstack([state, action], dtype=np.float64)
    learner = np.zeros(len(both), bool)
    if s.ACTOR in dataset.features:
        learner = dataset.columns([s.ACTOR])[s.ACTOR].reshape(-1) == Actor.LEARNER
    table = dataset.episodes
    spans = zip(table.index.tolist(), map(slice, table.start, table.stop), strict=True)
    rows = {
        episode: span for episode, span in spans if len(both[span]) > 1 and not learner[span].any()
    }
    if not rows or not np.isfinite(both).all():
        return  # reported by another check
    yield from _check_idle(dataset, rows, both)
    yield from _check_wraps(dataset, rows, both)
    if action.shape == state.shape:  # both list the same joints, as for LeRobot's robots
        found, told = np.hsplit(both, 2)
        names = np.array(features[1].labels)
        gripper = np.array([bool(_GRIPPER.search(name)) for name in names])
        arm = ~gripper if gripper.any() else np.arange(len(names)) < len(names) - 1
        yield from _check_lag(dataset, rows, told[:, arm], found[:, arm])
        yield from _check_joints(dataset, rows, told[:, arm], found[:, arm], names[arm])
        yield from _check_commands(told, found, names)


def _check_idle(dataset: Dataset, rows: Rows, both: F64) -> Iterator[Finding]:
    """Find seconds in which neither actions nor joints move, except at an episode's end."""
    extent = np.ptp(both, axis=0)
    both = both / np.where(extent > 1e-9, extent, np.inf)
    second = max(2, round(dataset.fps))
    idle: dict[int, int] = {}
    for episode, span in rows.items():
        starts = range(span.start, span.stop - second + 1, second)
        moving = [np.ptp(both[start : start + second], axis=0).max() > _STILL for start in starts]
        idle[episode] = max(np.flatnonzero(moving), default=-1) + 1 - sum(moving)
    share = sum(idle.values()) * second / len(both)
    if share > _IDLE:
        text = (
            f"nothing moves for seconds, in {share:.0%} of the frames: a policy learns to stand"
            " still"
        )
        yield of_episodes(dataset.root, s.ACTION, text, [*filter(idle.get, idle)])


def _check_wraps(dataset: Dataset, rows: Rows, both: F64) -> Iterator[Finding]:
    """Find joints whose angle jumps between two frames from one end of a turn, such as 180
    degrees, to the other.
    """
    labels = np.array([*dataset.features[s.STATE].labels, *dataset.features[s.ACTION].labels])
    for half in _HALF_TURNS:
        wraps = (np.abs(np.diff(both, axis=0)) > 1.8 * half) & (
            np.abs(both).max(axis=0) < 1.01 * half
        )
        where, joints = np.nonzero(
            [wraps[span.start : span.stop - 1].any(axis=0) for span in rows.values()]
        )
        if len(where):
            names = list_first(np.unique(labels[joints]))
            episodes = list_first(np.array([*rows])[np.unique(where)])
            text = (
                f"{names} jump by a turn at +-{half:.4g} (episodes {episodes}): relative actions"
                " are a turn too long there, and a policy's mean of both ends points away"
            )
            yield warning(s.STATE, text, f"unwrap the angles, or move the joint's zero: {_AGAIN}")


def _check_lag(dataset: Dataset, rows: Rows, told: F64, found: F64) -> Iterator[Finding]:
    """Find actions that lag the motion that they should cause, or lead it by too much, by
    cross-correlation.
    """
    lengths = [span.stop - span.start for span in rows.values()]
    longest = min(round(dataset.fps / 2) + 1, int(np.median(lengths)) // 4)
    inner = np.concatenate(
        [np.arange(span.start + longest, span.stop - longest) for span in rows.values()]
    )
    leads = range(-longest, longest + 1)
    curves = np.array([_correlate(told[inner - lead], found[inner]) for lead in leads])
    followed = curves.max(axis=0) > 0.9  # other actions are not position targets
    if longest < 2 or followed.sum() < max(2, len(followed) / 2):
        return
    curve = curves[:, followed].mean(axis=1)
    best = leads[int(curve.argmax())]
    fine = min(max(best, 1), max(2, round(_LEAD * dataset.fps)))
    if fine != best and 1 - curve[fine + longest] > 1.3 * (1 - curve.max()) + 1e-6:
        how = f"lead the joints by {best}" if best > 0 else f"lag the joints by {-best}"
        figures = f"correlation {curve.max():.4f}; {curve[fine + longest]:.4f} at a lead of {fine}"
        remedy = f"a frame's action must be the one sent after its observation: {_AGAIN}"
        yield warning(s.ACTION, f"actions {how} frames ({figures})", remedy)


def _correlate(left: F64, right: F64) -> F64:
    """Return the correlations (n,) of columns (T, n), 0 for a constant one."""
    left = left - left.mean(axis=0)
    right = right - right.mean(axis=0)
    scale = np.linalg.norm(left, axis=0) * np.linalg.norm(right, axis=0)
    return (left * right).sum(axis=0) / np.maximum(scale, 1e-9)


def _check_joints(
    dataset: Dataset, rows: Rows, told: F64, found: F64, names: NDArray[np.str_]
) -> Iterator[Finding]:
    """Find joints whose zero or sign differs between episodes, by their start and their
    correlation with actions.
    """
    if len(rows) < _LEAST:
        return
    starts = np.array([found[span.start] for span in rows.values()])
    agree = np.array([_correlate(told[span], found[span]) for span in rows.values()])
    against = (agree < -0.8) & (np.median(agree, axis=0) > 0.8)
    least = 0.1 * np.ptp(found, axis=0)
    for place, name in enumerate(names):
        apart = _find_apart(starts[:, place], least[place])
        for what, values, odd in (
            ("starts at", starts[:, place], apart),
            ("correlates with its action by", agree[:, place], against[:, place]),
        ):
            if odd.any():
                means = f"{values[odd].mean():.3g}, in other episodes {values[~odd].mean():.3g}"
                text = f"{name} {what} {means}: its zero or sign differs"
                yield of_episodes(dataset.root, s.STATE, text, np.array([*rows])[odd])


def _find_apart(values: F64, least: float) -> Mask:
    """Return which values (E,) are outliers: beyond a gap wider than `least` and 5 times the
    range of either side.
    """
    ranked = np.sort(values)
    cut = int(np.argmax(np.diff(ranked))) + 1
    above = values >= ranked[cut]
    extent = max(np.ptp(ranked[:cut]), np.ptp(ranked[cut:]))
    is_apart = ranked[cut] - ranked[cut - 1] > max(5 * extent, least)
    return (above if 2 * above.sum() <= len(values) else ~above) & is_apart


def _check_commands(told: F64, found: F64, names: NDArray[np.str_]) -> Iterator[Finding]:
    """Find commands that are never reached, mostly of the gripper.

    A joint that moves by a small share of its command but correlates with it has other units: no
    finding.
    """
    low, high = np.quantile(told, [0.01, 0.99], axis=0)
    below, above = np.quantile(found, [0.01, 0.99], axis=0)
    extent = high - low
    share = (above - below) / np.maximum(extent, 1e-9)
    stuck = (share < 0.05) & (np.abs(_correlate(told, found)) < 0.5)
    inside = (
        (share >= 0.05) & (share < 0.5) & (np.minimum(below - low, high - above) > 0.1 * extent)
    )
    for joint in np.flatnonzero((extent > 1e-6) & (stuck | inside)):
        commanded = f"{names[joint]} is commanded {low[joint]:.3g} to {high[joint]:.3g}"
        text = f"{commanded}, but only moves from {below[joint]:.3g} to {above[joint]:.3g}"
        yield warning(s.ACTION, text, f"calibrate or free that joint: {_AGAIN}")


def check_cameras(dataset: Dataset) -> Iterator[Finding]:
    """Find black or frozen pictures and swapped cameras, from some pictures of up to 100
    episodes.
    """
    # first, so that a broken file raises as in other checks
    table, _ = dataset.episodes, dataset.data_files
    chosen = np.flatnonzero(table.length > 1)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(_EPISODES, len(chosen))).astype(int)]
    rows = np.linspace(
        table.start[chosen], table.stop[chosen] - 1, _PICTURES, dtype=np.int64, axis=-1
    )
    cameras = [key for key in dataset.cameras if dataset.features[key].is_rgb and len(rows)]
    seen = {key: _thumbnails(dataset, key, rows) for key in cameras}
    state = np.zeros((len(dataset), 1))
    if s.STATE in dataset.features:
        state = dataset.columns([s.STATE])[s.STATE].reshape(len(dataset), -1).astype(np.float64)
    tenth = 0.1 * np.maximum(np.ptp(state, axis=0), 1e-9)
    moved = (np.abs(np.diff(state[rows], axis=1)) > tenth).any(axis=2)
    for key, pictures in seen.items():
        dark = (pictures.mean(axis=2) < _DARK).mean(axis=1) > 0.5
        still = np.abs(np.diff(pictures, axis=1)).max(axis=2) < _SAME
        frozen = (still & moved).sum(axis=1) > np.maximum(1, moved.sum(axis=1) / 2)
        odd = {"is black": dark, "is frozen while the joints move": frozen & ~dark}
        odd |= {
            f"is swapped with {other}": _find_swapped(pictures, seen[other])
            for other in seen
            if other > key
        }
        for what, which in odd.items():
            if which.any():
                text = f"{what} in {which.sum()} of {len(which)} episodes"
                yield of_episodes(dataset.root, key, text, table.index[chosen[which]])


def _thumbnails(dataset: Dataset, camera: str, rows: NDArray[np.int64]) -> F64:
    """Return small pictures, (E, P, values), of these rows, (E, P)."""
    reader = dataset.camera(camera)
    small = [
        [
            Image.fromarray(picture).resize(_SIZE, Image.Resampling.BOX)
            for picture in reader.rows(episode)
        ]
        for episode in rows
    ]
    return np.array(small, np.float64).reshape(*rows.shape, -1)


def _find_swapped(left: F64, right: F64) -> Mask:
    """Return the episodes, (E,), in which each of two cameras shows what the other one shows in
    most episodes.
    """
    pictures = np.stack([left.mean(axis=1), right.mean(axis=1)])
    typical = np.median(pictures, axis=1, keepdims=True)
    straight, crossed = (
        np.abs(pictures - usual).mean(axis=2).sum(axis=0) for usual in (typical, typical[::-1])
    )
    return (crossed < 0.5 * straight) & (straight > _DARK)


CHECKS = (check_cameras, check_motions)
