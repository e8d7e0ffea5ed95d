"""Why a policy may not learn from a dataset: warnings about its motions and cameras, with numbers.

Motions are checked in episodes driven by a teacher; if a learner drives, actions are labels that were not executed.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il.bridges.doctor.finding import Finding, list_first, of_episodes, warning
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
_SIDE = 16
_HALF_TURNS = (180.0, np.pi)  # [deg], [rad]
_SAME, _DARK = 1.5, 10.0  # pixel values, 0 to 255: largest change in an unchanged thumbnail, mean of a black picture
_AGAIN = "correct the recorder, and record again"


def check_motions(dataset: Dataset) -> Iterator[Finding]:
    """Check for idle time, wrapping joints, lagging actions, changed zeros, unreached commands."""
    features = [dataset.features.get(key) for key in (s.STATE, s.ACTION)]
    if not all(one and one.dtype in NUMBERS and len(one.shape) == 1 and one.size for one in features):
        return
    columns = dataset.columns([s.STATE, s.ACTION, *({s.ACTOR} & dataset.features.keys())])
    state, action = (columns[key].reshape(len(dataset), -1).astype(np.float64) for key in (s.STATE, s.ACTION))
    learner, table = columns.get(s.ACTOR, np.zeros(len(state))).reshape(-1) == Actor.LEARNER, dataset.episodes
    spans = zip(table.index.tolist(), map(slice, table.start, table.stop), strict=True)
    rows = {episode: one for episode, one in spans if len(state[one]) > 1 and not learner[one].any()}
    if not rows or not np.isfinite(state).all() or not np.isfinite(action).all():
        return  # reported by another check
    yield from _check_idle(dataset, rows, np.hstack([state, action]))
    yield from _check_wraps(dataset, rows, np.hstack([state, action]))
    if action.shape == state.shape:  # both list the same joints, as for LeRobot's robots
        names = np.array(dataset.features[s.ACTION].labels)
        gripper = np.array([bool(_GRIPPER.search(name)) for name in names])
        arm = ~gripper if gripper.any() else np.arange(len(names)) < len(names) - 1
        yield from _check_lag(dataset, rows, action[:, arm], state[:, arm])
        yield from _check_joints(dataset, rows, action[:, arm], state[:, arm], names[arm])
        yield from _check_commands(action, state, names)


def _check_idle(dataset: Dataset, rows: Rows, both: F64) -> Iterator[Finding]:
    """Find seconds in which neither actions nor joints move, except at an episode's end."""
    both = both / np.where(np.ptp(both, axis=0) > 1e-9, np.ptp(both, axis=0), np.inf)
    second, idle = max(2, round(dataset.fps)), dict[int, int]()
    for episode, span in rows.items():
        starts = range(span.start, span.stop - second + 1, second)
        moving = [np.ptp(both[start : start + second], axis=0).max() > _STILL for start in starts]
        idle[episode] = max(np.flatnonzero(moving), default=-1) + 1 - sum(moving)
    if (share := sum(idle.values()) * second / len(both)) > _IDLE:
        text = f"nothing moves for seconds, in {share:.0%} of the frames: a policy learns to stand still"
        yield of_episodes(dataset.root, s.ACTION, text, [episode for episode, seconds in idle.items() if seconds])


def _check_wraps(dataset: Dataset, rows: Rows, both: F64) -> Iterator[Finding]:
    """Find joints whose angle jumps between two frames from one end of a turn, such as 180 degrees, to the other."""
    labels = np.array([*dataset.features[s.STATE].labels, *dataset.features[s.ACTION].labels])
    for half in _HALF_TURNS:
        wraps = (np.abs(np.diff(both, axis=0)) > 1.8 * half) & (np.abs(both).max(axis=0) < 1.01 * half)
        where, joints = np.nonzero([wraps[span.start : span.stop - 1].any(axis=0) for span in rows.values()])
        if len(where):
            names, episodes = np.unique(labels[joints]), np.array([*rows])[np.unique(where)]
            what = f"{list_first(names)} jump by a turn at +-{half:.4g} (episodes {list_first(episodes)})"
            follows = "relative actions are a turn too long there, and a policy's mean of both ends points away"
            yield warning(s.STATE, f"{what}: {follows}", f"unwrap the angles, or move the joint's zero: {_AGAIN}")


def _check_lag(dataset: Dataset, rows: Rows, told: F64, found: F64) -> Iterator[Finding]:
    """Find actions that lag the motion that they should cause, or lead it by too much, by cross-correlation."""
    longest = min(round(dataset.fps / 2) + 1, int(np.median([span.stop - span.start for span in rows.values()])) // 4)
    inner = np.concatenate([np.arange(span.start + longest, span.stop - longest) for span in rows.values()])
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
    left, right = left - left.mean(axis=0), right - right.mean(axis=0)
    return (left * right).sum(axis=0) / np.maximum(np.linalg.norm(left, axis=0) * np.linalg.norm(right, axis=0), 1e-9)


def _check_joints(dataset: Dataset, rows: Rows, told: F64, found: F64, names: NDArray[np.str_]) -> Iterator[Finding]:
    """Find joints whose zero or sign differs between episodes, by their start and their correlation with actions."""
    starts = np.array([found[span.start] for span in rows.values()])
    agree = np.array([_correlate(told[span], found[span]) for span in rows.values()])
    against = (agree < -0.8) & (np.median(agree, axis=0) > 0.8)
    for place, name in enumerate(names if len(rows) >= _LEAST else ()):
        apart = _find_apart(starts[:, place], 0.1 * np.ptp(found[:, place]))
        measures = (("starts at", starts, apart), ("correlates with its action by", agree, against[:, place]))
        for what, values, odd in measures:
            if odd.any():
                means = f"{values[odd, place].mean():.3g}, in other episodes {values[~odd, place].mean():.3g}"
                text = f"{name} {what} {means}: its zero or sign differs"
                yield of_episodes(dataset.root, s.STATE, text, np.array([*rows])[odd])


def _find_apart(values: F64, least: float) -> Mask:
    """Return which values (E,) are outliers: beyond a gap wider than `least` and 5 times the range of either side."""
    ranked = np.sort(values)
    cut = int(np.argmax(np.diff(ranked)))
    gap, extent = ranked[cut + 1] - ranked[cut], max(ranked[cut] - ranked[0], ranked[-1] - ranked[cut + 1])
    above = values > ranked[cut]
    return (above if 2 * above.sum() <= len(values) else ~above) & (gap > max(5 * extent, least))


def _check_commands(action: F64, state: F64, names: NDArray[np.str_]) -> Iterator[Finding]:
    """Find commands that are never reached, mostly of the gripper.

    A joint that moves by a small share of its command but correlates with it has other units: no finding.
    """
    for name, told, found in zip(names, action.T, state.T, strict=True):
        (low, high), (below, above) = np.quantile(told, [0.01, 0.99]), np.quantile(found, [0.01, 0.99])
        share = (above - below) / max(high - low, 1e-9)
        stuck = share < 0.05 and abs(_correlate(told, found)) < 0.5
        inside = 0.05 <= share < 0.5 and min(below - low, high - above) > 0.1 * (high - low)
        if high - low > 1e-6 and (stuck or inside):
            text = f"{name} is commanded {low:.3g} to {high:.3g}, but only moves from {below:.3g} to {above:.3g}"
            yield warning(s.ACTION, text, f"calibrate or free that joint: {_AGAIN}")


def check_cameras(dataset: Dataset) -> Iterator[Finding]:
    """Find black or frozen pictures and swapped cameras, from some pictures of up to 100 episodes."""
    table, _ = dataset.episodes, dataset.data_files  # first, so that a broken file raises as in other checks
    chosen = np.flatnonzero(table.length > 1)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(_EPISODES, len(chosen))).astype(int)]
    rows = np.linspace(table.start[chosen], table.stop[chosen] - 1, _PICTURES, dtype=np.int64, axis=-1)
    cameras = [key for key in dataset.cameras if dataset.features[key].is_rgb and len(rows)]
    seen = {key: np.stack([_thumbnails(dataset.frames(key, one)) for one in rows]) for key in cameras}
    moved = np.zeros((len(rows), _PICTURES - 1), bool)  # whether a joint moves by a tenth of its range in between
    if seen and s.STATE in dataset.features:
        state = dataset.columns([s.STATE])[s.STATE].reshape(len(dataset), -1).astype(np.float64)
        moved = (np.abs(np.diff(state[rows], axis=1)) > 0.1 * np.maximum(np.ptp(state, axis=0), 1e-9)).any(axis=2)
    for key, pictures in seen.items():
        dark = (pictures.mean(axis=(2, 3, 4)) < _DARK).mean(axis=1) > 0.5
        still = np.abs(np.diff(pictures, axis=1)).max(axis=(2, 3, 4)) < _SAME
        frozen = (still & moved).sum(axis=1) > np.maximum(1, moved.sum(axis=1) / 2)
        odd = {"is black": dark, "is frozen while the joints move": frozen & ~dark}
        odd |= {f"is swapped with {other}": _find_swapped(pictures, seen[other]) for other in seen if other > key}
        for what, which in odd.items():
            if which.any():
                text = f"{what} in {which.sum()} of {len(which)} episodes"
                yield of_episodes(dataset.root, key, text, table.index[chosen[which]])


def _thumbnails(pictures: NDArray[np.uint8]) -> F64:
    small = [Image.fromarray(one).resize((_SIDE, _SIDE), Image.Resampling.BOX) for one in pictures]
    return np.stack([np.asarray(one, dtype=np.float64) for one in small])


def _find_swapped(left: F64, right: F64) -> Mask:
    """Return the episodes, (E,), in which each of two cameras shows what the other one shows in most episodes."""
    pictures = np.stack([left.mean(axis=1), right.mean(axis=1)])
    typical = np.median(pictures, axis=1, keepdims=True)
    straight, crossed = (np.abs(pictures - one).mean(axis=(2, 3, 4)).sum(axis=0) for one in (typical, typical[::-1]))
    return (crossed < 0.5 * straight) & (straight > _DARK)


CHECKS = (check_cameras, check_motions)
