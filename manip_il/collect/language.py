"""Texts that are true of every frame, in LeRobot's columns of language, from what the expert knows.

`language_persistent` has an episode's subtasks, what is left, what is done, how the hand moves, and
other words for the task; `language_events` has what happens in a single frame: where the expert
takes over, and questions with answers from the state.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from itertools import pairwise
from typing import Any

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from manip_il.collect.edits import EditSource, EditTarget, rewrite
from manip_il.data import schema
from manip_il.data.dataset import EpisodeData, Own
from manip_il.data.info import Info
from manip_il.learn.paraphrases import paraphrases
from manip_il.mdp import F64, Actor, State
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.table import make_env, make_expert

LANGUAGE_PERSISTENT, LANGUAGE_EVENTS = "language_persistent", "language_events"
_CALLS = pa.field("tool_calls", pa.list_(pa.json_()))
_ROLE = pa.field("role", pa.string(), nullable=False)
_TIME = pa.field("timestamp", pa.float32(), nullable=False)
_TEXTS = [pa.field("content", pa.string()), pa.field("style", pa.string())]
_CAMERA = pa.field("camera", pa.string())
# as in `lerobot.datasets.language`, whose import takes seconds
PERSISTENT_ROW = pa.struct([_ROLE, *_TEXTS, _TIME, _CAMERA, _CALLS])
EVENT_ROW = pa.struct([_ROLE, *_TEXTS, _CAMERA, _CALLS])
Row = dict[str, Any]
_SHORTEST = 0.01  # of a motion that is told [m]
_TRACED = 8  # most points of a trace
_BESIDE = 0.05  # least distance of things of which one is left of the other [width of a picture]
_PARAPHRASES = 16  # most other texts of a task
_FEATURE = {"dtype": "language", "shape": [1], "names": None}


def annotate_dataset(source: EditSource, target: EditTarget) -> Info:
    """Write `source` with LeRobot's columns `language_persistent` and `language_events`.

    All other columns and the pictures stay the same; texts that the source has are replaced.

    Args:
        source: The dataset to annotate.
        target: The new dataset's folder, and how it is written.

    Returns:
        The new dataset's `info.json`.

    Raises:
        ManipError: as in `Dataset.stored_episodes` and `write_episodes`.
    """
    dataset = source.dataset
    own = Own(dataset.spec, dataset.fingerprint, dataset.provenance)
    points = [key for key in dataset.spec.keypoint_keys if key in dataset.features]
    read = (schema.SIM_STATE, schema.LABEL_VALID, schema.EXPERT_PHASE, schema.ACTOR)
    episodes = dataset.stored_episodes([*read, schema.SUCCESS, *points])
    work = partial(language_columns, source.env, dataset.spec)
    features = dataset.stored_features | dict.fromkeys(
        (LANGUAGE_PERSISTENT, LANGUAGE_EVENTS), _FEATURE
    )
    return rewrite(source, target, work, own, features, episodes)


def language_columns(
    env: EnvConfig, spec: EnvironmentSpec, episode: EpisodeData
) -> dict[str, pa.ChunkedArray]:
    """Return the texts of an episode as LeRobot's columns, (T,) lists of rows each.

    Args:
        env: The environment of the episode's states.
        spec: The dataset's, which names its cameras and keypoints.
        episode: Its states, labels, actors, successes and keypoints.
    """
    told = EpisodeTexts.of(env, spec, episode)
    persistent = sorted(told.persistent(), key=lambda row: row["timestamp"])
    events: list[list[Row]] = [[] for _ in range(len(told.subtasks))]
    for frame, row in told.events():
        events[frame].append(row)
    everywhere = np.zeros(len(events), int)
    return {
        LANGUAGE_PERSISTENT: _column([persistent], everywhere, PERSISTENT_ROW),
        LANGUAGE_EVENTS: _column(events, np.arange(len(events)), EVENT_ROW),
    }


@dataclass(frozen=True)
class EpisodeTexts:
    """What is told of an episode.

    Attributes:
        spec: The dataset's, with cameras, keypoints and the rate.
        task: What the episode asks.
        subtasks: What the expert does in every frame, (T,); "" where it has no words.
        positions: True positions of the hand, (T, 3) [m]; () if the world does not tell them.
        facts: What is true of a frame, by frame: thing, attribute, value.
        nouns: Words for the keypoints.
        object: Words for what the hand reaches first.
        actor: Who drove, (T,).
        solved: Whether the episode ended as a success.
        keypoints: Of each camera, (T, K, 3), as in `Observation`.
    """

    spec: EnvironmentSpec
    task: str
    subtasks: Sequence[str]
    positions: F64
    facts: Mapping[int, Sequence[tuple[str, str, Any]]]
    nouns: Mapping[str, str]
    object: str
    actor: NDArray[Any]
    solved: bool
    keypoints: Mapping[str, NDArray[Any]]

    @classmethod
    def of(cls, config: EnvConfig, spec: EnvironmentSpec, episode: EpisodeData) -> EpisodeTexts:
        """Restore every state of an episode, and ask its world for words.

        Args:
            config: The environment of the states.
            spec: The dataset's.
            episode: The columns that `language_columns` reads.
        """
        env, expert = make_env(config), make_expert(config)
        columns = {key: np.asarray(one) for key, one in episode.columns.items()}
        states, labels = columns[schema.SIM_STATE], columns[schema.EXPERT_PHASE].reshape(-1)
        known = columns[schema.LABEL_VALID].reshape(-1) > 0
        subtasks: list[str] = []
        positions: list[F64] = []
        facts: dict[int, list[tuple[str, str, Any]]] = {}
        for frame, vector in enumerate(states):
            state = State.from_vector(vector)
            env.set_state(state)
            phase = labels[frame] if known[frame] else expert.label(state, env).phase
            subtasks.append(env.subtask(int(phase)))
            if (hand := env.positions().get("hand")) is not None:
                positions.append(hand.copy())
            if frame % round(spec.fps) == 0:
                facts[frame] = env.facts()
        points = {
            camera: columns[key].reshape(len(states), -1, 3)
            for key, camera in spec.keypoint_keys.items()
            if key in columns
        }
        nouns = {name: env.noun(name) for name in spec.keypoints if "." not in name}
        return cls(
            spec,
            episode.tasks[0],
            _without_gaps(subtasks),
            np.array(positions),
            facts,
            nouns,
            env.noun("object") if "object" in env.positions() else "",
            columns[schema.ACTOR].reshape(-1),
            bool(columns[schema.SUCCESS].reshape(-1)[-1]),
            points,
        )

    @cached_property
    def starts(self) -> list[int]:
        """The frames in which a subtask begins."""
        told = self.subtasks
        return [at for at in range(len(told)) if told[at] and (at == 0 or told[at] != told[at - 1])]

    def persistent(self) -> Iterator[Row]:
        """Yield what stays true until another text of the same style."""
        for text in paraphrases(self.task)[:_PARAPHRASES]:
            yield self._lasting(0, "task_aug", text, "user")
        for start, end in pairwise((*self.starts, len(self.subtasks) - 1)):
            yield self._lasting(start, "subtask", self.subtasks[start])
            yield self._lasting(start, "plan", self.plan(start))
            if len(self.positions):
                yield self._lasting(start, "motion", _motion(self.positions[[start, end]]))
            if start:
                yield self._lasting(start, "memory", self.memory(start))
        for at in self.takeovers:
            if at not in self.starts:
                yield self._lasting(at, "plan", self.plan(at))

    def events(self) -> Iterator[tuple[int, Row]]:
        """Yield what happens in single frames: the frame, and the text."""
        for at in self.takeovers:
            text = self.subtasks[at]
            yield at, _row("user", "interjection", f"Stop. Now {text}.")
            say = {"name": "say", "arguments": {"text": f"I {text}."}}
            call = json.dumps({"type": "function", "function": say})
            yield at, _row("assistant", None, None) | {"tool_calls": [call]}
        cameras = self.spec.cameras
        # one question a frame: LeRobot's recipes, which name no camera, find no other
        for turn, frame in enumerate(self.facts if cameras else ()):
            camera = cameras[turn % len(cameras)]
            points = self.keypoints[camera][frame] if camera in self.keypoints else ()
            if asked := self.questions(frame, points):
                key = schema.IMAGES + camera
                question, answer = asked[turn % len(asked)]
                yield frame, _row("user", "vqa", question, key)
                yield frame, _row("assistant", "vqa", json.dumps(answer), key)
        for camera, seen in self.keypoints.items():
            for at, end in pairwise((*self.starts, len(self.subtasks))):
                if trace := self.trace(seen[at:end]):
                    key = schema.IMAGES + camera
                    yield at, _row("assistant", "trace", json.dumps(trace), key)

    @property
    def takeovers(self) -> list[int]:
        """The frames in which the expert takes over from a policy, if it has words for them."""
        expert = self.actor != Actor.LEARNER
        taken = np.flatnonzero(expert[1:] & ~expert[:-1]) + 1
        return [at for at in taken.tolist() if self.subtasks[at]]

    def plan(self, frame: int) -> str:
        """Return what is left at a frame, as a numbered list. Of an episode that failed, only what
        comes next is known.
        """
        left = (
            self._without_repeats(frame, len(self.subtasks))
            if self.solved
            else [self.subtasks[frame]]
        )
        return "\n".join(f"{number}. {text}" for number, text in enumerate(left, 1))

    def memory(self, frame: int) -> str:
        """Return what is done at a frame."""
        done = self._without_repeats(0, frame + 1)[:-1]
        return f"Done: {'; '.join(done)}." if done else "Nothing is done yet."

    def questions(self, frame: int, points: Sequence[Any]) -> list[tuple[str, dict[str, Any]]]:
        """Return questions on a frame, each with its answer in one of LeRobot's forms.

        Args:
            frame: Its number.
            points: The keypoints in a camera's picture, (K, 3); () if they are not known.
        """
        at = dict(zip(self.spec.keypoints, points, strict=False))
        seen = {noun: at[name] for name, noun in self.nouns.items() if name in at and at[name][2]}
        found: list[tuple[str, dict[str, Any]]] = []
        for noun, point in seen.items():
            answer = {"label": noun, "point_format": "xy", "point": self._pixel(point)}
            found.append((f"Where is the {noun}?", answer))
        for (one, here), (other, there) in pairwise(seen.items()):
            if abs(gap := here[0] - there[0]) > _BESIDE:
                relation = "left_of" if gap < 0 else "right_of"
                answer = {"subject": one, "relation": relation, "object": other}
                found.append((f"Is the {one} left or right of the {other}?", answer))
        for noun, attribute, value in self.facts[frame]:
            answer = {"label": noun, "attribute": attribute, "value": value}
            found.append((f"What is the {attribute} of the {noun}?", answer))
        return found

    def trace(self, points: NDArray[Any]) -> dict[str, Any] | None:
        """Return the path of the object in a camera's picture; None if it is not seen to move.

        Args:
            points: The keypoints during a subtask, (S, K, 3).
        """
        name = next((name for name, noun in self.nouns.items() if noun == self.object), None)
        if name is None:
            return None
        path = points[:, self.spec.keypoints.index(name)]
        path = path[path[:, 2] > 0]
        few = np.unique(np.linspace(0, len(path) - 1, _TRACED).round().astype(int))
        seen = [self._pixel(one) for one in path[few]] if len(path) else []
        if all(one == seen[0] for one in seen):
            return None
        return {"label": self.object, "point_format": "xy", "points": seen}

    def _pixel(self, point: NDArray[Any]) -> list[int]:
        """Return a keypoint (3,) as column and row of a pixel, (2,)."""
        height, width = self.spec.image_size
        return [int(point[0] * width), int(point[1] * height)]

    def _without_repeats(self, start: int, stop: int) -> list[str]:
        """Return the subtasks from one frame to another, in order, without what was repeated."""
        found: list[str] = []
        for text in self.subtasks[start:stop]:
            if text in found:  # a slip: what came since is done once more
                del found[found.index(text) :]
            if text:
                found.append(text)
        return found

    def _lasting(self, frame: int, style: str, text: str, role: str = "assistant") -> Row:
        time = float(np.float32(frame / self.spec.fps))
        return _row(role, style, text) | {"timestamp": time}


def _row(role: str, style: str | None, text: str | None, camera: str | None = None) -> Row:
    return {"role": role, "content": text, "style": style, "camera": camera, "tool_calls": None}


def _without_gaps(texts: Sequence[str]) -> list[str]:
    """Return texts in which a state without words has those of the last one before it that had
    some; of the first after it if there is none.
    """
    found = list(texts)
    for at in range(1, len(found)):
        found[at] = found[at] or found[at - 1]
    first = next(filter(None, found), "")
    return [text or first for text in found]


def _motion(ends: F64) -> str:
    """Return in words how the hand moves from one place to another, (2, 3) [m]."""
    x, y, z = (ends[1] - ends[0]).tolist()
    ways = ((x, "along +x", "along -x"), (y, "along +y", "along -y"), (z, "up", "down"))
    words = [
        f"{abs(way) * 100:.0f} cm {plus if way > 0 else minus}"
        for way, plus, minus in ways
        if abs(way) > _SHORTEST
    ]
    return f"move the hand {', '.join(words)}" if words else "hold the hand still"


def _column(
    lists: Sequence[Sequence[Row]], places: NDArray[Any], kind: pa.StructType
) -> pa.ChunkedArray:
    """Return lists of rows as LeRobot's column, the list of a given number in each place, (T,)."""
    calls = pa.field(_CALLS.name, pa.list_(pa.string()))  # JSON is built from text alone
    plain = pa.struct([*(one for one in kind if one.name != _CALLS.name), calls])
    array = pa.array(lists, pa.list_(plain)).cast(pa.list_(kind))
    return pa.chunked_array([array.take(pa.array(places))])
