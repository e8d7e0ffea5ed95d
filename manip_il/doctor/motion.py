"""Why a policy will not learn from the motions of a dataset, of any origin. Thresholds are shares, without units."""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.doctor.finding import WARNING, Finding, delete, list_first
from manip_il.mdp import Actor

F64 = NDArray[np.float64]
_GRIPPER = re.compile(r"grip|finger|jaw|hand|claw", re.IGNORECASE)
_STILL, _IDLE = 0.01, 0.1  # of every joint's range, within a second; of all frames
_LEAD = 0.4  # by which actions may be ahead of the joints that follow them [s]
_CLIPPED = 0.05  # of all frames
_LEAST = 5  # episodes that are compared with each other
_AGAIN = "correct what recorded it, and record again"


@dataclass(frozen=True)
class Motion:
    """State (T, n) and action (T, m). rows: of every episode that a teacher drove: elsewhere actions move nothing.

    joints: name, place in the action and place in the state; the gripper apart. frames: of these episodes.
    """

    dataset: Dataset
    state: F64
    action: F64
    rows: dict[int, slice]
    joints: list[tuple[str, int, int]]
    grippers: list[tuple[str, int, int]]
    frames: int


def check_motions(dataset: Dataset) -> Iterator[Finding]:
    """Check for idle stretches, late or early actions, joints that changed, commands in vain, texts of two motions."""
    features = [dataset.features.get(key) for key in (s.STATE, s.ACTION)]
    if not all(one and one.dtype in NUMBERS and len(one.shape) == 1 and one.size for one in features):
        return
    columns = dataset.columns([s.STATE, s.ACTION, *({s.ACTOR} & dataset.features.keys())])
    state, action = (columns[key].reshape(len(dataset), -1).astype(np.float64) for key in (s.STATE, s.ACTION))
    learner = columns.get(s.ACTOR, np.zeros(len(state))).reshape(-1) == Actor.LEARNER
    table = dataset.episodes
    spans = zip(table.index.tolist(), map(slice, table.start, table.stop), strict=True)
    rows = {episode: one for episode, one in spans if len(state[one]) > 1 and not learner[one].any()}
    left, right = dataset.features[s.ACTION].labels, dataset.features[s.STATE].labels
    pairs = [(name, left.index(name), right.index(name)) for name in left if name in right]
    if not pairs and len(left) == len(right):
        pairs = [(name, place, place) for place, name in enumerate(left)]
    grippers = [pair for pair in pairs if _GRIPPER.search(pair[0])] or pairs[-1:]
    joints = [pair for pair in pairs if pair not in grippers]
    frames = sum(len(state[one]) for one in rows.values())
    if rows and np.isfinite(state).all() and np.isfinite(action).all():  # else named by another check
        motion = Motion(dataset, state, action, rows, joints, grippers, frames)
        for check in (_check_idle, _check_lag, _check_joints, _check_reached, _check_clipped, _check_texts):
            yield from check(motion)


CHECKS = (check_motions,)


def _check_idle(motion: Motion) -> Iterator[Finding]:
    """Seconds in which neither actions nor joints move; to rest at the end is no fault."""
    both = np.hstack([motion.state, motion.action])
    both = both / np.where(np.ptp(both, axis=0) > 1e-9, np.ptp(both, axis=0), np.inf)
    second, idle = max(2, round(motion.dataset.fps)), dict[int, int]()
    for episode, rows in motion.rows.items():
        starts = range(rows.start, rows.stop - second + 1, second)
        moving = [np.ptp(both[start : start + second], axis=0).max() > _STILL for start in starts]
        idle[episode] = max(np.flatnonzero(moving), default=-1) + 1 - sum(moving)
    share = sum(idle.values()) * second / motion.frames
    if share > _IDLE:
        worst = sorted((episode for episode in idle if idle[episode]), key=lambda episode: -idle[episode])
        text = f"nothing moves for seconds, in {share:.0%} of the frames, most in episodes {list_first(worst)}"
        remedy = delete(motion.dataset.root, sorted(worst))
        yield Finding(WARNING, s.ACTION, f"{text}: a policy learns to stand still there", remedy)


def _check_lag(motion: Motion) -> Iterator[Finding]:
    """Actions that come after the motion that they should cause, or long before it, by cross-correlation."""
    median = int(np.median([rows.stop - rows.start for rows in motion.rows.values()]))
    reach = min(round(motion.dataset.fps / 2) + 1, median // 4)
    if reach < 2 or len(motion.joints) < 2:
        return

    def inner(values: F64, side: int, lead: int) -> F64:
        """Return the joints' numbers `lead` frames earlier, without the ends of episodes and without their means."""
        long = [rows for rows in motion.rows.values() if rows.stop - rows.start >= 4 * reach]
        pieces = [values[rows.start + reach - lead : rows.stop - reach - lead] for rows in long]
        return np.vstack([one - one.mean(axis=0) for one in pieces])[:, [joint[side] for joint in motion.joints]]

    leads, moved = np.arange(-reach, reach + 1), inner(motion.state, 2, 0)
    told = (inner(motion.action, 1, lead) for lead in leads)
    correlation = np.array([(one * moved).sum(axis=0) / np.sqrt((one**2).sum(axis=0) + 1e-12) for one in told])
    correlation /= np.sqrt((moved**2).sum(axis=0) + 1e-12)
    followed = correlation.max(axis=0) > 0.9  # the others' actions are no targets
    if followed.sum() < max(2, len(motion.joints) / 2):
        return
    curve = correlation[:, followed].mean(axis=1)
    best = int(leads[curve.argmax()])
    fine = int(np.clip(best, 1, max(2, round(_LEAD * motion.dataset.fps))))
    if fine != best and 1 - curve[fine + reach] > 1.3 * (1 - curve.max()) + 1e-6:
        how = f"lead the joints by {best}" if best > 0 else f"lag the joints by {-best}"
        figures = f"correlation {curve.max():.4f}; {curve[fine + reach]:.4f} at a lead of {fine}"
        remedy = f"the action of a frame is what is sent after its observation: {_AGAIN}"
        yield Finding(WARNING, s.ACTION, f"actions {how} frames ({figures})", remedy)


def _check_joints(motion: Motion) -> Iterator[Finding]:
    """A joint whose zero or sign differs between episodes: by where it starts, and by how it follows its action."""
    for name, left, right in motion.joints if len(motion.rows) >= _LEAST else ():
        pieces = [(motion.action[rows, left], motion.state[rows, right]) for rows in motion.rows.values()]
        spread = np.ptp(motion.state[:, right])
        starts = np.array([found[0] for _, found in pieces])
        off = np.array([np.median(found - told) for told, found in pieces])
        agree = np.array([_correlate(*piece) if np.ptp(piece[0]) > 0.1 * spread else 1.0 for piece in pieces])
        for what, values, odd in (
            ("starts at", starts, _apart(starts, 5, 0.1 * spread)),
            ("differs from its action by", off, _apart(off, 5, 0.05 * spread)),
            ("correlates with its action by", agree, (agree < -0.8) & bool(np.median(agree) > 0.8)),
        ):
            if odd.any():
                episodes = np.array(list(motion.rows))[odd]
                figures = f"{values[odd].mean():.3g} in episodes {list_first(episodes)}, else {values[~odd].mean():.3g}"
                text = f"{name} {what} {figures}: its zero or sign differs"
                yield Finding(WARNING, s.STATE, text, delete(motion.dataset.root, episodes))
                break


def _correlate(left: F64, right: F64) -> float:
    spread = left.std() * right.std()
    return 0.0 if spread < 1e-12 else float(np.mean((left - left.mean()) * (right - right.mean())) / spread)


def _apart(values: F64, times: float, least: float = 0.0) -> NDArray[np.bool_]:
    """Return which of the numbers (E,) stand apart from most, by a gap of `least` and `times` what those differ by."""
    ranked = np.sort(values)
    cut = int(np.argmax(np.diff(ranked)))
    gap, extent = ranked[cut + 1] - ranked[cut], max(ranked[cut] - ranked[0], ranked[-1] - ranked[cut + 1])
    above = values > ranked[cut]
    return (above if 2 * above.sum() <= len(values) else ~above) & (gap > max(times * extent, least, 1e-9))


def _check_reached(motion: Motion) -> Iterator[Finding]:
    """Commands, of the gripper as a rule, that the joint never comes near, though its unit is theirs."""
    for name, left, right in [*motion.joints, *motion.grippers]:
        told, found = motion.action[:, left], motion.state[:, right]
        (low, high), (below, above) = np.quantile(told, [0.01, 0.99]), np.quantile(found, [0.01, 0.99])
        share = (above - below) / max(high - low, 1e-9)
        stuck = share < 0.05 and abs(_correlate(told, found)) < 0.5
        inside = 0.05 <= share < 0.5 and min(below - low, high - above) > 0.1 * (high - low)
        if high - low > 1e-6 and (stuck or inside):
            text = f"{name} is told {low:.3g} to {high:.3g}, and is {below:.3g} to {above:.3g}: commands never reached"
            yield Finding(WARNING, s.ACTION, text, f"calibrate or free that joint: {_AGAIN}")


def _check_clipped(motion: Motion) -> Iterator[Finding]:
    """Actions that run into a limit and stay exactly there; not those of grippers, nor where an episode rests."""
    grippers = {left for _, left, _ in motion.grippers}
    for place, name in enumerate(motion.dataset.features[s.ACTION].labels):
        column = motion.action[:, place]
        for limit in {column.min(), column.max()} if len(np.unique(column)) > 50 and place not in grippers else ():
            at = [column[rows] == limit for rows in motion.rows.values()]
            held = sum(int(one.sum()) for one in at if not one[0] and not one[-1])
            if held > _CLIPPED * motion.frames:
                text = f"{name} is cut off at {limit:.6g} in {held / motion.frames:.0%} of the frames"
                yield Finding(WARNING, s.ACTION, text, f"widen that limit: {_AGAIN}")


def _check_texts(motion: Motion) -> Iterator[Finding]:
    """Two different motions, with nothing between, that neither text nor first observation tells apart."""
    points = np.array([np.linspace(rows.start, rows.stop - 1, 12).astype(int) for rows in motion.rows.values()])
    paths = (motion.state / np.maximum(motion.state.std(axis=0), 1e-9))[points].reshape(len(points), -1)
    features, table = motion.dataset.features.values(), motion.dataset.episodes
    seen = [one.key for one in features if one.key.startswith("observation.") and one.dtype in NUMBERS]
    firsts = np.hstack([motion.dataset.columns([key])[key][points[:, 0]].reshape(len(points), -1) for key in seen])
    texts = dict(zip(table.index.tolist(), map(tuple, table.tasks), strict=True))
    for text in set(texts.values()):
        same = np.flatnonzero([texts[episode] == text for episode in motion.rows])
        if len(same) < 2 * _LEAST:
            continue
        centred = paths[same] - paths[same].mean(axis=0)
        odd = _apart(centred @ np.linalg.svd(centred, full_matrices=False)[2][0], 2.5)
        if 5 * odd.sum() < len(odd):
            continue
        here, there = firsts[same[odd]], firsts[same[~odd]]
        if not ((here.max(axis=0) < there.min(axis=0)) | (there.max(axis=0) < here.min(axis=0))).any():
            what = f"{odd.sum()} of {len(odd)} episodes ({list_first(np.array(list(motion.rows))[same[odd]])})"
            said = f"{what} move in another way than the rest, for one text {' '.join(text)[:60]!r}"
            remedy = "give them a text of their own: lerobot-edit-dataset --operation.type=modify_tasks --help"
            yield Finding(WARNING, "task", said, remedy)
