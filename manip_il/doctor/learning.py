"""Why a policy will not learn from a dataset, of any origin: its motions and its cameras. Warnings, with numbers.

Motions are looked at in episodes that a teacher drove: where a learner drives, actions are labels and move nothing.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from manip_il import checks
from manip_il.data import schema as s
from manip_il.data.dataset import Dataset
from manip_il.data.info import NUMBERS
from manip_il.doctor.finding import Finding, by_deletion, by_journals, list_first, warning
from manip_il.errors import ManipError
from manip_il.mdp import Actor

F64 = NDArray[np.float64]
_GRIPPER = re.compile(r"grip|finger|jaw|hand|claw", re.IGNORECASE)
_STILL, _IDLE = 0.01, 0.1  # of every joint's range, within a second; of all frames
_LEAD = 0.4  # by which actions may be ahead of the joints that follow them [s]
_CLIPPED = 0.05  # of all frames
_LEAST = 5  # episodes that are compared with each other
_AGAIN = "correct what recorded it, and record again"
_EPISODES, _PICTURES, _SIDE = 100, 6, 16  # that are decoded, of each; height and width of a thumbnail
_SAME, _DARK = 1.5, 10.0  # levels, of 255: change of the most changed part of a thumbnail; mean of a picture
Rows = dict[int, slice]  # of episodes, by their numbers


@dataclass(frozen=True)
class Joint:
    """One that both action and state have: what it is told, and where it is, (T,)."""

    name: str
    told: F64
    found: F64
    is_gripper: bool

    def correlate(self, rows: slice = slice(None)) -> float:
        """Return the correlation of both in these rows; 0 if one does not move."""
        told, found = self.told[rows] - self.told[rows].mean(), self.found[rows] - self.found[rows].mean()
        return float(told @ found / max(np.linalg.norm(told) * np.linalg.norm(found), 1e-9))


def check_motions(dataset: Dataset) -> Iterator[Finding]:
    """Check for idle stretches, late or early actions, joints that changed, commands in vain, texts of two motions."""
    features = [dataset.features.get(key) for key in (s.STATE, s.ACTION)]
    if not all(one and one.dtype in NUMBERS and len(one.shape) == 1 and one.size for one in features):
        return
    columns = dataset.columns([s.STATE, s.ACTION, *({s.ACTOR} & dataset.features.keys())])
    state, action = (columns[key].reshape(len(dataset), -1).astype(np.float64) for key in (s.STATE, s.ACTION))
    learner, table = columns.get(s.ACTOR, np.zeros(len(state))).reshape(-1) == Actor.LEARNER, dataset.episodes
    spans = zip(table.index.tolist(), map(slice, table.start, table.stop), strict=True)
    rows = {episode: one for episode, one in spans if len(state[one]) > 1 and not learner[one].any()}
    left, right = dataset.features[s.ACTION].labels, dataset.features[s.STATE].labels
    pairs = [(left.index(name), right.index(name)) for name in left if name in right]
    if not pairs and len(left) == len(right):
        pairs = [(place, place) for place in range(len(left))]
    grippers = [place for place, _ in pairs if _GRIPPER.search(left[place])] or [place for place, _ in pairs[-1:]]
    joints = [Joint(left[i], action[:, i], state[:, j], i in grippers) for i, j in pairs]
    if rows and np.isfinite(state).all() and np.isfinite(action).all():  # else named by another check
        yield from _check_idle(dataset, np.hstack([state, action]), rows)
        yield from _check_lag(dataset, joints, rows)
        yield from _check_joints(dataset, joints, rows)
        yield from _check_commands(joints, rows)
        yield from _check_texts(dataset, state, rows)


def _check_idle(dataset: Dataset, both: F64, rows: Rows) -> Iterator[Finding]:
    """Seconds in which neither actions nor joints move; to rest at the end is no fault."""
    both = both / np.where(np.ptp(both, axis=0) > 1e-9, np.ptp(both, axis=0), np.inf)
    second, idle = max(2, round(dataset.fps)), dict[int, int]()
    for episode, span in rows.items():
        starts = range(span.start, span.stop - second + 1, second)
        moving = [np.ptp(both[start : start + second], axis=0).max() > _STILL for start in starts]
        idle[episode] = max(np.flatnonzero(moving), default=-1) + 1 - sum(moving)
    if (share := sum(idle.values()) * second / len(both)) > _IDLE:
        worst = sorted((episode for episode in idle if idle[episode]), key=lambda episode: -idle[episode])
        text = f"nothing moves for seconds, in {share:.0%} of the frames, most in episodes {list_first(worst)}"
        remedy = by_deletion(dataset.root, sorted(worst))
        yield warning(s.ACTION, f"{text}: a policy learns to stand still there", remedy)


def _check_lag(dataset: Dataset, joints: list[Joint], rows: Rows) -> Iterator[Finding]:
    """Actions that come after the motion that they should cause, or long before it, by cross-correlation."""
    lengths = [span.stop - span.start for span in rows.values()]
    reach = min(round(dataset.fps / 2) + 1, int(np.median(lengths)) // 4)
    long = [span for span, length in zip(rows.values(), lengths, strict=True) if length >= 4 * reach]

    def inner(values: F64, lead: int) -> F64:
        """Return numbers `lead` frames earlier, without the ends of episodes, of mean 0 and norm 1."""
        pieces = [values[span.start + reach - lead : span.stop - reach - lead] for span in long]
        joined = np.concatenate([piece - piece.mean() for piece in pieces])
        return joined / max(np.linalg.norm(joined), 1e-9)

    leads, curves = list(range(-reach, reach + 1)), list[F64]()
    for joint in joints:
        moved = inner(joint.found, 0)
        curve = np.array([inner(joint.told, lead) @ moved for lead in leads])
        if not joint.is_gripper and curve.max() > 0.9:  # other actions are no targets
            curves.append(curve)
    if reach < 2 or len(curves) < max(2, len(joints) / 2):
        return
    curve = np.mean(curves, axis=0)
    best = leads[int(curve.argmax())]
    fine = min(max(best, 1), max(2, round(_LEAD * dataset.fps)))
    if fine != best and 1 - curve[fine + reach] > 1.3 * (1 - curve.max()) + 1e-6:
        how = f"lead the joints by {best}" if best > 0 else f"lag the joints by {-best}"
        figures = f"correlation {curve.max():.4f}; {curve[fine + reach]:.4f} at a lead of {fine}"
        remedy = f"the action of a frame is what is sent after its observation: {_AGAIN}"
        yield warning(s.ACTION, f"actions {how} frames ({figures})", remedy)


def _check_joints(dataset: Dataset, joints: list[Joint], rows: Rows) -> Iterator[Finding]:
    """A joint whose zero or sign differs between episodes: by where it starts, and by how it follows its action."""
    for joint in joints if len(rows) >= _LEAST else ():
        spread = np.ptp(joint.found)
        starts = np.array([joint.found[span.start] for span in rows.values()])
        agree = np.array([joint.correlate(span) for span in rows.values()])
        for what, values, odd in (
            ("starts at", starts, _find_apart(starts, 5, 0.1 * spread)),
            ("correlates with its action by", agree, (agree < -0.8) & bool(np.median(agree) > 0.8)),
        ):
            if odd.any() and not joint.is_gripper:
                episodes = np.array(list(rows))[odd]
                figures = f"{values[odd].mean():.3g} in episodes {list_first(episodes)}, else {values[~odd].mean():.3g}"
                text = f"{joint.name} {what} {figures}: its zero or sign differs"
                yield warning(s.STATE, text, by_deletion(dataset.root, episodes))


def _find_apart(values: F64, times: float, least: float = 1e-9) -> NDArray[np.bool_]:
    """Return which of the numbers (E,) stand apart from most, by a gap of `least` and `times` what those differ by."""
    ranked = np.sort(values)
    cut = int(np.argmax(np.diff(ranked)))
    gap, extent = ranked[cut + 1] - ranked[cut], max(ranked[cut] - ranked[0], ranked[-1] - ranked[cut + 1])
    above = values > ranked[cut]
    return (above if 2 * above.sum() <= len(values) else ~above) & (gap > max(times * extent, least))


def _check_commands(joints: list[Joint], rows: Rows) -> Iterator[Finding]:
    """Commands, of the gripper as a rule, that are never reached; others that are cut off at a limit.

    Units of both are the same, or a joint follows by a small share. At rest at an episode's end nothing is cut off.
    """
    for joint in joints:
        (low, high), (below, above) = (np.quantile(one, [0.01, 0.99]) for one in (joint.told, joint.found))
        share = (above - below) / max(high - low, 1e-9)
        stuck = share < 0.05 and abs(joint.correlate()) < 0.5
        inside = 0.05 <= share < 0.5 and min(below - low, high - above) > 0.1 * (high - low)
        if high - low > 1e-6 and (stuck or inside):
            text = f"{joint.name} is told {low:.3g} to {high:.3g}, and is {below:.3g} to {above:.3g}"
            yield warning(s.ACTION, f"{text}: commands never reached", f"calibrate or free that joint: {_AGAIN}")
        for limit in {joint.told.min(), joint.told.max()} if len(np.unique(joint.told)) > 50 else ():
            at = [joint.told[span] == limit for span in rows.values()]
            share = sum(int(one.sum()) for one in at if not one[0] and not one[-1]) / len(joint.told)
            if share > _CLIPPED and not joint.is_gripper:
                text = f"{joint.name} is cut off at {limit:.6g} in {share:.0%} of the frames"
                yield warning(s.ACTION, text, f"widen that limit: {_AGAIN}")


def _check_texts(dataset: Dataset, state: F64, rows: Rows) -> Iterator[Finding]:
    """Two different motions, with nothing between, that neither text nor first observation tells apart."""
    points = np.array([np.linspace(span.start, span.stop - 1, 12).astype(int) for span in rows.values()])
    paths = (state / np.maximum(state.std(axis=0), 1e-9))[points].reshape(len(points), -1)
    seen = [one.key for one in dataset.info.of_dtype(*NUMBERS) if one.key.startswith("observation.")]
    firsts = np.hstack([dataset.columns([key])[key][points[:, 0]].reshape(len(points), -1) for key in seen])
    texts = dict(zip(dataset.episodes.index.tolist(), map(tuple, dataset.episodes.tasks), strict=True))
    for text in set(texts.values()):
        same = np.array([place for place, episode in enumerate(rows) if texts[episode] == text])
        if len(same) < 2 * _LEAST:
            continue
        centred = paths[same] - paths[same].mean(axis=0)
        odd = _find_apart(centred @ np.linalg.svd(centred, full_matrices=False)[2][0], 2.5)
        here, there = firsts[same[odd]], firsts[same[~odd]]
        if 5 * odd.sum() >= len(odd) and not ((here.max(0) < there.min(0)) | (there.max(0) < here.min(0))).any():
            what = f"{odd.sum()} of {len(odd)} episodes ({list_first(np.array(list(rows))[same[odd]])})"
            said = f"{what} move in another way than the rest, for one text {' '.join(text)[:60]!r}"
            remedy = "give them a text of their own: lerobot-edit-dataset --operation.type=modify_tasks --help"
            yield warning("task", said, remedy)


def check_cameras(dataset: Dataset) -> Iterator[Finding]:
    """Check some pictures of every episode: they are decoded and have their size, and show what they should."""
    table, root = dataset.episodes, dataset.root
    chosen = np.flatnonzero(table.length > 1)
    chosen = chosen[np.linspace(0, len(chosen) - 1, min(_EPISODES, len(chosen))).astype(int)]
    rows = np.linspace(table.start[chosen], table.stop[chosen] - 1, _PICTURES, dtype=np.int64, axis=-1)
    seen: dict[str, F64] = {}
    for key in [key for key in dataset.cameras if dataset.features[key].is_rgb and len(rows)]:
        try:
            seen[key] = np.stack([_thumbnails(dataset.frames(key, one)) for one in rows])
        except ManipError as problem:
            text = checks.one_line(problem).replace(f"{root}/", "").partition("; run `manip-il")[0]
            yield Finding(key, text, by_journals(root))
    moved = np.zeros((len(rows), _PICTURES - 1), bool)  # by a tenth of a joint's range, from picture to picture
    if seen and s.STATE in dataset.features:
        state = dataset.columns([s.STATE])[s.STATE].reshape(len(dataset), -1).astype(np.float64)
        moved = (np.abs(np.diff(state[rows], axis=1)) > 0.1 * np.maximum(np.ptp(state, axis=0), 1e-9)).any(axis=2)
    for key, pictures in seen.items():
        dark = (pictures.mean(axis=(2, 3, 4)) < _DARK).mean(axis=1) > 0.5
        still = np.abs(np.diff(pictures, axis=1)).max(axis=(2, 3, 4)) < _SAME
        frozen = (still & moved).sum(axis=1) > np.maximum(1, moved.sum(axis=1) / 2)
        odd = {"is black": dark, "stands still while the joints move": frozen & ~dark}
        odd |= {f"is swapped with {other}": _find_swapped(pictures, seen[other]) for other in seen if other > key}
        for what, which in odd.items():
            if which.any():
                episodes = table.index[chosen[which]]
                text = f"{what} in {which.sum()} of {len(which)} episodes ({list_first(episodes)})"
                yield warning(key, text, by_deletion(root, episodes))


def _thumbnails(pictures: NDArray[np.uint8]) -> F64:
    small = [Image.fromarray(one).resize((_SIDE, _SIDE), Image.Resampling.BOX) for one in pictures]
    return np.stack([np.asarray(one, dtype=np.float64) for one in small])


def _find_swapped(left: F64, right: F64) -> NDArray[np.bool_]:
    """Return the episodes, (E,), in which two cameras look like each other in the other episodes."""
    pictures = np.stack([left.mean(axis=1), right.mean(axis=1)])
    typical = np.median(pictures, axis=1, keepdims=True)
    straight, crossed = (np.abs(pictures - one).mean(axis=(2, 3, 4)).sum(axis=0) for one in (typical, typical[::-1]))
    return (crossed < 0.5 * straight) & (straight > _DARK)


CHECKS = (check_cameras, check_motions)
