"""Several tasks of one robot as one world: each episode has one of them, which its seed chooses.

Recording, DAgger and evaluation need not know: the task is in an episode's text and in its state.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from functools import cache
from typing import Any, override

import numpy as np
from numpy.typing import NDArray

from manip_il.caching import cached_per_thread
from manip_il.errors import MismatchError, UsageError
from manip_il.mdp import F32, F64, STATE_EXTRAS, Label, Observation, State
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import Environment, EnvironmentSpec, Expert, Outcome, WorldKind
from manip_il.worlds.table import complete, env_fingerprint, env_spec, make_env, world_of

PRESENT = "has."  # begins an input that says whether a task has the number of that name
_ONE_TASK = {"perturbed", "shown in a window"}  # what cannot be done with several tasks
# fields of a spec in which tasks may differ
_MAY_DIFFER = {
    "task",
    "environment_state_names",
    "sim_state_size",
    "instruction",
    "phases",
    "horizon",
    "can",
    "all_cameras",
    "default_cameras",
    "points",
    "shares_model",
    "has_progress",
    "drawing_version",
}


def task_number(seed: int, count: int) -> int:
    """Return the number of the task, of so many, that the episode of a seed has.

    Every task has as many of consecutive seeds as any other, and each task meets all conditions,
    which also take turns by seed.
    """
    return (seed + seed // count) % count


def divide(count: int, weights: Sequence[float]) -> list[int]:
    """Return how many of `count` episodes each task gets, in proportion to weights (K,)."""
    shares = count * np.asarray(weights) / np.sum(weights)
    numbers = np.floor(shares).astype(int)
    # the largest remainders get what is left; of equal ones, the first
    numbers[np.argsort(numbers - shares, kind="stable")[: count - numbers.sum()]] += 1
    return numbers.tolist()


class Tasks:
    """Several tasks: what they have in common, and each one's part of a state and an observation.

    Args:
        config: Settings of all of them.
        parts: Settings of each.

    Raises:
        MismatchError: if two of them have different robots, actions or rates.
    """

    def __init__(self, config: EnvConfig, parts: tuple[EnvConfig, ...]):
        self.parts, specs = parts, [env_spec(part) for part in parts]
        first = specs[0]
        for one in fields(first):
            for spec in specs if one.name not in _MAY_DIFFER else ():
                if (value := getattr(spec, one.name)) != getattr(first, one.name):
                    mine = getattr(first, one.name)
                    raise MismatchError(one.name, first.task, mine, spec.task, value)
        names = list(dict.fromkeys(name for one in specs for name in one.environment_state_names))
        having = {
            name: tuple(name in spec.environment_state_names for spec in specs) for name in names
        }
        # tasks that have the same numbers of those that some tasks lack -> the first of these
        partial = {has: name for name, has in reversed(having.items()) if not all(has)}
        present = np.array(list(partial), np.float32).reshape(len(partial), len(specs))
        self._absent = [np.append(np.zeros(len(names), np.float32), has) for has in present.T]
        self._places = [
            [names.index(name) for name in spec.environment_state_names] for spec in specs
        ]
        phases = list(dict.fromkeys(phase for one in specs for phase in one.phases))
        self.phases = [[phases.index(phase) for phase in one.phases] for one in specs]
        self._sizes = [one.sim_state_size for one in specs]
        cameras = tuple(
            name for name in first.all_cameras if all(name in one.all_cameras for one in specs)
        )
        self.spec = replace(
            first,
            task=str(config.task),
            environment_state_names=(*names, *(PRESENT + name for name in partial.values())),
            sim_state_size=1 + max(self._sizes) + STATE_EXTRAS,
            instruction="",
            phases=tuple(phases),
            horizon=config.horizon,
            can=tuple(
                one
                for one in first.can
                if one not in _ONE_TASK and all(one in other.can for other in specs)
            ),
            all_cameras=cameras,
            default_cameras=tuple(name for name in first.default_cameras if name in cameras),
            points=(),
            shares_model=all(one.shares_model for one in specs),
            has_progress=all(one.has_progress for one in specs),
            drawing_version=max(one.drawing_version for one in specs),
        )

    def united(self, number: int, numbers: F32) -> F32:
        """Return the environment state of all tasks, (k,), with that of one task, (j,), in its
        places and 0 in all others.
        """
        whole = self._absent[number].copy()
        whole[self._places[number]] = numbers
        return whole

    def packed(self, number: int, state: State) -> State:
        """Return one task's state as one of all tasks, which all have the same size."""
        vector = np.zeros(1 + max(self._sizes))
        vector[0] = number
        vector[1 : 1 + self._sizes[number]] = state.to_vector()
        return replace(state, physics=vector, variation=np.empty(0))

    def unpacked(self, state: State) -> tuple[int, State]:
        """Return the task's number and its own state. Raises `MismatchError` for other states."""
        vector = state.physics
        size = 1 + max(self._sizes)
        if len(vector) != size:
            raise MismatchError("size of the state", "it", len(vector), self.spec.task, size)
        number = int(vector[0])
        if not 0 <= number < len(self.parts):
            most = len(self.parts) - 1
            raise MismatchError("number of the task", "it", number, self.spec.task, f"0 to {most}")
        inner = State.from_vector(vector[1 : 1 + self._sizes[number]])
        return number, replace(inner, seed=state.seed, begun=state.begun)


class SeveralEnv(Environment):
    """An environment of several tasks; its state says which one it has.

    Args:
        tasks: The tasks.
        cameras: Cameras rendered in every step; None for none.
        conditions: How episodes differ from the nominal world, in turn by seed.
    """

    def __init__(self, tasks: Tasks, cameras: CameraConfig | None, conditions: Sequence[Condition]):
        self._tasks, self._settings = tasks, (cameras, tuple(conditions))
        self._free = _free_envs(tasks, *self._settings)
        self._number, self.one = 0, self._take(0)
        self.actions = self.one.actions

    def __del__(self) -> None:
        if hasattr(self, "one"):
            self._free[self._number].append(self.one)

    @property
    @override
    def spec(self) -> EnvironmentSpec:
        return self._tasks.spec

    @property
    @override
    def progress(self) -> float:
        return self.one.progress

    @override
    def start(self, seed: int) -> None:
        self._choose(task_number(seed, len(self._tasks.parts)))
        self.one.start(seed)

    @override
    def observe(self) -> Observation:
        seen = self.one.observe()
        around = self._tasks.united(self._number, seen.environment_state)
        return replace(seen, environment_state=around, keypoints={})

    @override
    def step(self, action: NDArray[Any]) -> Outcome:
        return self.one.step(action)

    @override
    def get_state(self) -> State:
        return self._tasks.packed(self._number, self.one.get_state())

    @override
    def set_state(self, state: State) -> None:
        inner = self._enter(state)
        self.one.set_state(inner)

    @override
    def positions(self) -> dict[str, F64]:
        return self.one.positions()

    @override
    def subtask(self, phase: int) -> str:
        numbers = self._tasks.phases[self._number]
        return self.one.subtask(numbers.index(phase)) if phase in numbers else ""

    @override
    def noun(self, name: str) -> str:
        return self.one.noun(name)

    @override
    def facts(self) -> list[tuple[str, str, Any]]:
        return self.one.facts()

    @override
    def varied(self, state: State, drawn: Mapping[str, Any]) -> State:
        inner = self._enter(state)
        return self._tasks.packed(self._number, self.one.varied(inner, drawn))

    @override
    def redrawn(self, state: State, rng: np.random.Generator) -> State | None:
        inner = self._enter(state)
        made = self.one.redrawn(inner, rng)
        return None if made is None else self._tasks.packed(self._number, made)

    def _enter(self, state: State) -> State:
        """Choose the task of a state, and return that task's own state."""
        number, inner = self._tasks.unpacked(state)
        self._choose(number)
        return inner

    def _choose(self, number: int) -> None:
        """Change to a task, and give the environment of the one before back."""
        if number != self._number:
            chosen = self._take(number)
            self._free[self._number].append(self.one)
            self._number, self.one = number, chosen

    def _take(self, number: int) -> Environment:
        """Return an environment of a task that no other instance uses."""
        free = self._free[number]
        return free.pop() if free else make_env(self._tasks.parts[number], *self._settings)


@cached_per_thread(4)
def _free_envs(
    tasks: Tasks, cameras: CameraConfig | None, conditions: tuple[Condition, ...]
) -> list[list[Environment]]:
    """Return the unused environments of each task, kept as making one takes long."""
    return [[] for _ in tasks.parts]


class SeveralExpert(Expert):
    """The experts of several tasks.

    Args:
        tasks: The tasks.
    """

    def __init__(self, tasks: Tasks):
        self._tasks = tasks
        self._experts: dict[int, Expert] = {}

    @override
    def label(self, state: State, environment: Environment | None = None) -> Label:
        number, inner = self._tasks.unpacked(state)
        if number not in self._experts:
            part = self._tasks.parts[number]
            self._experts[number] = world_of(part.robot, part.task).expert(part)
        running = environment.one if isinstance(environment, SeveralEnv) else None
        label = self._experts[number].label(inner, running)
        return replace(label, phase=self._tasks.phases[number][label.phase])


class SeveralTasks(WorldKind):
    """Several tasks of one world.

    Args:
        kind: The world.
        names: The tasks.
    """

    def __init__(self, kind: WorldKind, names: tuple[str, ...]):
        self._kind, self.names = kind, names
        self.tasks = cache(lambda config: Tasks(config, self._parts(config)))

    def _parts(self, config: EnvConfig) -> tuple[EnvConfig, ...]:
        return tuple(complete(replace(config, task=name)) for name in self.names)

    @override
    def complete(self, config: EnvConfig) -> EnvConfig:
        """Fill in rate and horizon, the longest one; each task keeps its own tolerance."""
        if config.object:
            raise UsageError(
                f"object is {config.object}, and there are several tasks; omit --task.object"
            )
        parts = self._parts(config)
        horizon = max(part.horizon for part in parts)
        return replace(config, control_hz=parts[0].control_hz, horizon=horizon)

    @override
    def environment(
        self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]
    ) -> SeveralEnv:
        """Return an environment of all tasks.

        Args:
            config: Its settings, complete.
            cameras: Cameras rendered in every step; None for none.
            conditions: How episodes differ from the nominal world, in turn by seed.
        """
        return SeveralEnv(self.tasks(config), cameras, conditions)

    @override
    def expert(self, config: EnvConfig) -> SeveralExpert:
        return SeveralExpert(self.tasks(config))

    @override
    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        """Return what is the same for all tasks, and one hash of what is not."""
        found = [env_fingerprint(part) for part in self._parts(config)]
        keys = dict.fromkeys(key for one in found for key in one)
        values = {key: [one.get(key, "") for one in found] for key in keys}
        return {
            key: of[0] if len(set(of)) == 1 else hashlib.sha256("\n".join(of).encode()).hexdigest()
            for key, of in values.items()
        }

    @override
    def lerobot_words(self, robot: str, task: str) -> list[str]:
        return self._kind.lerobot_words(robot, task)

    @override
    def affecting(self, config: EnvConfig, condition: Condition, *, sees: bool) -> Condition | None:
        """Return the part of a condition that changes something in every task.

        Args:
            config: Settings of the environment.
            condition: Ranges of what differs from the nominal world.
            sees: Whether the policy has cameras.
        """
        left: Condition | None = condition
        for part in self._parts(config):
            left = left and self._kind.affecting(part, left, sees=sees)
        return left
