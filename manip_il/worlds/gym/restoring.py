"""What the future of an environment depends on, as one vector of numbers, and back."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any

import gymnasium
import mujoco
import numpy as np
from numpy.typing import NDArray

from manip_il.errors import ManipError
from manip_il.mdp import F64

WHOLE = int(mujoco.mjtState.mjSTATE_INTEGRATION)
_LARGEST = 10_000  # numbers of an array of a model or an environment that is part of a state


def simulation(env: Any) -> tuple[mujoco.MjModel, mujoco.MjData] | None:
    """Return the model and data of a MuJoCo environment, of gymnasium or `dm_control`; None for
    any other.
    """
    inner = env.unwrapped
    physics: Any = getattr(getattr(inner, "_env", inner), "physics", inner)
    found: list[Any] = [getattr(physics, name, None) for name in ("model", "data")]
    model, data = (getattr(one, "ptr", one) for one in found)
    return (model, data) if isinstance(model, mujoco.MjModel) else None


class Simulated:
    """State of a MuJoCo environment.

    It is MuJoCo's integration state, the arrays of the model that differ between episodes, and
    every number and array of numbers among the attributes of the environment and its wrappers.

    Args:
        env: The environment.
        model: Its model.
        data: Its data.
    """

    def __init__(self, env: Any, model: mujoco.MjModel, data: mujoco.MjData):
        self._env = env
        self._model, self._data = model, data
        self._size = mujoco.mj_stateSize(model, WHOLE)
        self._first = model_arrays(model)
        self._differing: dict[str, NDArray[Any]] = {}
        # (wrapper or environment, name) -> a value that it had
        self._like: dict[tuple[Any, str], Any] = {}
        self._may_be_none = set[tuple[Any, str]]()

    def look(self) -> None:
        """Note what is part of a state; to be called at the start of episodes and within one."""
        for name, value in model_arrays(self._model).items():
            if not np.array_equal(value, self._first[name]):
                self._differing[name] = getattr(self._model, name)
        for layer in _layers(self._env):
            for name, value in sorted(vars(layer).items()):
                if value is None:
                    self._may_be_none.add((layer, name))
                elif _is_numbers(value) and not _is_view(value):
                    self._like.setdefault((layer, name), value)

    def get(self) -> F64:
        """Return the state, (p,)."""
        found = [
            physics_of(self._model, self._data),
            *(np.ravel(array) for array in self._differing.values()),
        ]
        for place, like in self._like.items():
            value = getattr(*place)
            if place in self._may_be_none:
                found.append(np.array([value is not None]))
                value = np.zeros_like(like) if value is None else value
            if np.shape(value) != np.shape(like):
                layer, name = place
                raise ManipError(
                    f"{name} of {type(layer).__name__} had the shape {np.shape(like)} and has"
                    f" {np.shape(value)}; give the world its own `state` and `restore`"
                )
            found.append(np.ravel(value))
        return np.concatenate([one.astype(np.float64) for one in found])

    def set(self, state: F64) -> None:
        """Restore a state, (p,)."""
        begin = 0
        physics, rest = np.split(state, [self._size])
        for array in self._differing.values():
            end = begin + array.size
            array[:] = rest[begin:end].reshape(array.shape)
            begin = end
        for place, like in self._like.items():
            is_there = True
            if place in self._may_be_none:
                is_there, begin = bool(rest[begin]), begin + 1
            end = begin + np.size(like)
            setattr(*place, _converted(rest[begin:end], like) if is_there else None)
            begin = end
        mujoco.mj_setState(self._model, self._data, physics, WHOLE)
        self.forward()

    def forward(self) -> None:
        """Compute everything of MuJoCo's data that follows from the state."""
        physics = physics_of(self._model, self._data)
        mujoco.mj_forward(self._model, self._data)
        # because `mj_forward` has changed where the next step's solver begins
        mujoco.mj_setState(self._model, self._data, physics, WHOLE)


def physics_of(model: mujoco.MjModel, data: mujoco.MjData) -> F64:
    """Return MuJoCo's integration state, (p,)."""
    physics = np.empty(mujoco.mj_stateSize(model, WHOLE))
    mujoco.mj_getState(model, data, physics, WHOLE)
    return physics


def _converted(numbers: F64, like: Any) -> Any:
    """Return numbers (k,) as a value of another's type and shape."""
    if isinstance(like, np.ndarray):
        return numbers.reshape(like.shape).astype(like.dtype)
    return type(like)(numbers.item())


def model_arrays(model: mujoco.MjModel) -> dict[str, NDArray[Any]]:
    """Return copies of a model's arrays of numbers that are not large: name -> array, of any shape
    (...,).
    """
    found = {name: getattr(model, name) for name in dir(model) if not name.startswith("_")}
    return {
        name: value.copy()
        for name, value in found.items()
        if isinstance(value, np.ndarray) and value.dtype.kind == "f" and value.size <= _LARGEST
    }


def flat(seen: Any) -> F64 | None:
    """Return the numbers of an observation, (k,), in the order of its keys; None if it has
    anything else, such as pictures.
    """
    leaves = list(_leaves(seen))
    if not all(_is_numbers(leaf) for leaf in leaves):
        return None
    return np.concatenate([np.empty(0), *(np.ravel(leaf).astype(np.float64) for leaf in leaves)])


def unflat(numbers: F64, like: Any) -> Any:
    """Return an observation made of numbers (k,), with the keys, shapes and dtypes of another."""
    if isinstance(like, Mapping):
        made, begin = {}, 0
        for key, value in like.items():
            end = begin + sum(np.size(leaf) for leaf in _leaves(value))
            made[key], begin = unflat(numbers[begin:end], value), end
        return made
    return _converted(numbers, like)


def _leaves(seen: Any) -> Iterator[Any]:
    if isinstance(seen, Mapping):
        for value in seen.values():
            yield from _leaves(value)
    else:
        yield seen


def _layers(env: Any) -> Iterator[Any]:
    """Yield an environment's wrappers, the outermost first, then the environment."""
    while isinstance(env, gymnasium.Wrapper):
        yield env
        env = env.env
    yield env


def _is_view(value: Any) -> bool:
    """Return whether an array is a view of memory that numpy does not own, such as MuJoCo's."""
    while isinstance(value, np.ndarray):
        value = value.base
    return value is not None and not isinstance(value, bool | int | float | np.generic)


def _is_numbers(value: Any) -> bool:
    """Return whether a value is a finite number or a not too large array of these."""
    if not isinstance(value, bool | int | float | np.generic | np.ndarray):
        return False
    array = np.asarray(value)
    is_picture = array.dtype == np.uint8 and array.ndim > 1
    is_small = array.size <= _LARGEST and not is_picture
    return array.dtype.kind in "biuf" and is_small and bool(np.isfinite(array).all())
