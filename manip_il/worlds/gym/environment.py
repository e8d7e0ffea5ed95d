"""A world of one's own behind the contract: its environment, its expert, and how both are made."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import asdict, replace
from functools import cache, partial
from importlib.metadata import entry_points, packages_distributions, version
from pathlib import Path
from typing import Any, ClassVar, override

import gymnasium
import numpy as np
from numpy.typing import NDArray

from manip_il import checks
from manip_il.errors import ManipError, MismatchError, NotFiniteError, UnknownName, UsageError
from manip_il.mdp import F64, Label, Observation, State
from manip_il.option import NameOrPath
from manip_il.own_file import own_class, source_hash
from manip_il.robots.action_space import ActionSpace
from manip_il.robots.spec import model_bytes
from manip_il.sim.conditions import Condition
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import WORLD_GROUP, EnvConfig
from manip_il.worlds.contract import (
    OWN_ACTIONS,
    Ability,
    Environment,
    EnvironmentSpec,
    Expert,
    Outcome,
    Unable,
    WorldKind,
)
from manip_il.worlds.fingerprint import environment_fingerprint
from manip_il.worlds.gym.drawing import RENDER, camera_names, draw
from manip_il.worlds.gym.drawing import VERSION as DRAWN
from manip_il.worlds.gym.restoring import Simulated, flat, simulation, unflat
from manip_il.worlds.gym.world import AGENT, AROUND, GymWorld

SEEDS = 4  # episodes that are begun to see what is part of a state
_TOLERANCE = 0.05  # [m]; not used, as such a world says by itself what is solved


class GymEnv(Environment):
    """One environment of a world.

    Args:
        world: The world; one instance for each environment.
        cameras: Cameras rendered in every step; None for none.
        horizon: Most control steps of an episode; 0 for the world's own.

    Raises:
        UsageError: if the actions are not a flat `Box`, or `observe` gives something else than it
            should.
    """

    most_seed: ClassVar[int] = 2**32  # older environments take none that is larger
    hashes_code: ClassVar[bool] = True  # whether its fingerprint has the world's and its package's

    def __init__(self, world: GymWorld, cameras: CameraConfig | None = None, horizon: int = 0):
        self.world, self._cameras = world, cameras
        self.env = made(world)
        self.actions = self._found_actions()
        simulated = simulation(self.env)
        self._simulated, self._fresh = None, np.empty(0)
        self._is_own, self._sizes = _overrides(world, "restore"), ()
        self.start(0)
        if simulated and not self._is_own:
            self._simulated = self._found_state(*simulated)
            self._fresh = self._simulated.get()
            self.start(0)
        self._numbers = flat(self._seen)
        self._spec = self._described(horizon)
        self._spec = replace(self._spec, sim_state_size=len(self.get_state().to_vector()))

    @property
    @override
    def spec(self) -> EnvironmentSpec:
        return self._spec

    @property
    @override
    def progress(self) -> float:
        if not self._spec.has_progress:
            return float(self._streak > 0)
        return float(self.world.progress(self.env, self._info))

    @override
    def start(self, seed: int) -> None:
        if self._simulated:  # nothing is left of an earlier episode
            self._simulated.set(self._fresh)
        self._seen, self._info = self.world.reset(self.env, seed % self.most_seed)
        if self._simulated:  # poses that belong to the state, as after it is restored
            self._simulated.forward()
        self._count_from(State(np.empty(0), np.empty(0)))

    @override
    def observe(self) -> Observation:
        found = self._numbers_seen()
        pictures = {}
        if self._cameras is not None:
            pictures = {
                name: draw(self.world, self.env, name, self._cameras)
                for name in self._cameras.names
            }
        return Observation(*found, pictures, self.world.text(self.env))

    @override
    def step(self, action: NDArray[Any]) -> Outcome:
        given = self.actions.clip(action, self._step)
        if self.world.recurrent:
            self.label()
        self._seen, reward, terminated, truncated, self._info = self.env.step(
            given.astype(self.env.action_space.dtype)
        )
        self._label = None
        solved = bool(self.world.solved(self.env, self._info))
        self._step += 1
        self._streak = self._streak + 1 if solved else 0
        self._ever = self._ever or solved
        return Outcome(action, float(reward), solved, bool(terminated or truncated))

    def label(self) -> Label:
        """Return the expert's label of the present state; the expert is asked once a step."""
        if self._label is None:
            try:
                given = self.world.act(self.env, deepcopy(self._seen))
            except NotFiniteError as error:  # of a `Label`
                raise UsageError(f"{_at(self.world, 'act')}: {error}") from error
            self._label = self._checked(given)
        return self._label

    @override
    def get_state(self) -> State:
        counts = (self._step, self._streak, self._ever)
        if "restored" not in self._spec.can:
            return State(np.empty(0), np.empty(0), *counts)
        inner = self._simulated.get() if self._simulated else self.world.state(self.env)
        seen = flat(self._seen)
        if seen is None:
            raise ManipError(f"{self._spec.robot}: its observation has numbers that are not finite")
        return State(np.asarray(inner, np.float64), seen, *counts)

    @override
    def set_state(self, state: State) -> None:
        self._spec.require("restored", "give its class `state` and `restore`")
        size, expected = len(state.to_vector()), self._spec.sim_state_size
        if size != expected:
            raise MismatchError("size of the state", "it", size, self._spec.task, expected)
        if self._simulated:
            self._simulated.set(state.physics)
        else:
            self.world.restore(self.env, state.physics)
        self._seen, self._info = unflat(state.variation, self._seen), {}
        self._count_from(state)

    @override
    def positions(self) -> dict[str, F64]:
        return dict(self.world.positions(self.env))

    def _count_from(self, state: State) -> None:
        self._step, self._streak = state.step, state.streak
        self._ever, self._label = state.ever, None

    def _numbers_seen(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return `agent_pos` and `environment_state` as the world gives them."""
        found = self.world.observe(self.env, self._seen)
        if not isinstance(found, Mapping) or not found.keys() & {AGENT, AROUND}:
            raise UsageError(
                f"{_at(self.world, 'observe')}: returned {checks.shorten(found)}; expected a"
                f" mapping with {AGENT}, {AROUND} or both"
            )
        mine, around = (_numbers(self.world, found, key) for key in (AGENT, AROUND))
        sizes = (len(mine), len(around))
        if sizes != (self._sizes or sizes):
            raise UsageError(
                f"{_at(self.world, 'observe')}: {AGENT} and {AROUND} have {sizes} numbers; expected"
                f" {self._sizes} as before"
            )
        self._sizes = sizes
        return mine, around

    def _checked(self, given: Any) -> Label:
        label = given if isinstance(given, Label) else None
        try:
            action = np.asarray(label.action if label else given, np.float64)
        except (TypeError, ValueError):
            action = np.empty(0)
        size = len(self.actions.low)
        if action.shape != (size,) or not np.isfinite(action).all():
            raise UsageError(
                f"{_at(self.world, 'act')}: action is {checks.shorten(given)}; expected {size}"
                " finite numbers"
            )
        label = label or Label(action, 1, True, 0.0)
        return replace(label, action=np.clip(action, self.actions.low, self.actions.high))

    def _found_actions(self) -> ActionSpace:
        world, space = self.world, self.env.action_space
        if not isinstance(space, gymnasium.spaces.Box) or len(space.shape) != 1:
            raise UsageError(f"{_at(world, 'make')}: actions are {space}; expected a flat Box")
        low, high = (np.asarray(one, np.float64) for one in (space.low, space.high))
        scale = np.where(np.isfinite(high - low), high - low, 1.0)
        names = _names(world, "action", len(low))
        return ActionSpace(names, low, high, scale, np.zeros(len(low), bool))

    def _found_state(self, model: Any, data: Any) -> Simulated:
        """Return what restores the environment, as seen in the first steps of some episodes."""
        found = Simulated(self.env, model, data)
        middle = np.clip(0.0, self.actions.low, self.actions.high)
        for seed in range(SEEDS):
            self.start(seed)
            found.look()
            self.env.step(middle.astype(self.env.action_space.dtype))
            found.look()
        return found

    def _described(self, horizon: int) -> EnvironmentSpec:
        world, env = self.world, self.env
        mine, around = self._numbers_seen()
        cameras = world.cameras
        if cameras is None:
            cameras = camera_names(env)
        elif not _overrides(world, "render"):
            known = {*camera_names(env), *RENDER}
            if wrong := [name for name in cameras if name not in known]:
                raise UnknownName(f"camera of {_name(world)}", wrong[0], known)
        restores = (self._simulated or self._is_own) and self._numbers is not None
        can = list[Ability](["drawn"] if cameras else [])
        if restores and not world.recurrent:
            can.insert(0, "restored")
        settings = settings_of(world, env)
        return EnvironmentSpec(
            robot=_name(world),
            task=world.task or _name(world),
            fps=settings["fps"],
            joint_names=self.actions.names,
            state_names=_names(world, AGENT, len(mine)),
            environment_state_names=_names(world, AROUND, len(around)),
            sim_state_size=0,
            instruction=world.instruction or (world.task or _name(world)).replace("-", " "),
            action_meaning=OWN_ACTIONS,
            phases=world.phases,
            expert="recurrent" if world.recurrent else "stateless",
            horizon=horizon or settings["horizon"],
            can=tuple(can),
            all_cameras=cameras,
            default_cameras=cameras[:1],
            ends_solved=True,
            shares_model=False,
            has_progress=_overrides(world, "progress"),
            drawing_version=DRAWN,
        )


class GymExpert(Expert):
    """The expert of a world: its `act`.

    Args:
        make: Returns a new environment of the world.
    """

    def __init__(self, make: Callable[[], GymEnv]):
        self._make, self._env = make, None

    @override
    def label(self, state: State, environment: Environment | None = None) -> Label:
        if isinstance(environment, GymEnv):
            return environment.label()
        if self._env is None:
            self._env = self._make()
        if self._env.world.recurrent:
            raise Unable(
                f"the expert of {self._env.spec.robot} keeps memory, so it labels the states of a"
                " running episode alone; record again what you need"
            )
        self._env.set_state(state)
        return self._env.label()


class GymKind(WorldKind):
    """The environments and experts of one class.

    Args:
        cls: The class.
        env: What puts its environments behind the contract.
    """

    def __init__(self, cls: type[GymWorld], env: type[GymEnv] = GymEnv):
        for name in ("make", "act"):
            if not _overrides(cls, name):
                raise UsageError(
                    f"{inspect.getfile(cls)}: class {cls.__name__} has no `{name}`, which is"
                    " required (docs/new-env.md)"
                )
        self._cls, self._env = cls, env

    @override
    def complete(self, config: EnvConfig) -> EnvConfig:
        task = self._task(config)
        if isinstance(config.robot, Path):
            checks.check_unchanged(config.robot)
        if config.object:
            raise UsageError(
                f"object is {config.object}; {_name(self._cls)} has its own, so omit --task.object"
            )
        world = self._cls(task)
        own = settings_of(world, None if world.fps and world.horizon else made(world))
        fixed = {"control_hz": own["fps"], "tolerance": _TOLERANCE, "success_steps": 1}
        for name, value in fixed.items():
            given = getattr(config, name)
            if given not in (0, value):
                raise UsageError(
                    f"{name} is {given:g}; {_name(world)} has its own, expected {value:g}"
                )
        horizon = config.horizon or own["horizon"]
        return replace(config, task=task or _name(world), horizon=horizon, **fixed)

    @override
    def tasks_in(self, task: NameOrPath) -> tuple[NameOrPath, ...]:
        """Return the tasks that a text names, also by groups of the world's; each of them once."""
        groups = self._cls.groups
        named = super().tasks_in(task)
        return tuple(dict.fromkeys(one for name in named for one in groups.get(str(name), (name,))))

    def _task(self, config: EnvConfig) -> str:
        """Return the chosen task; "" if the world has only one."""
        asked, name = str(config.task), _name(self._cls)
        if not self._cls.tasks and asked in (EnvConfig.task, "", name):
            return ""
        known = self._cls.tasks or (name,)
        if asked not in known:
            raise UnknownName(f"task of {name}", asked, known)
        return asked

    @override
    def environment(
        self, config: EnvConfig, cameras: CameraConfig | None, conditions: Sequence[Condition]
    ) -> GymEnv:
        """Return an environment.

        Args:
            config: Its settings, complete; the class has its own for all but task and horizon.
            cameras: Cameras rendered in every step; None for none.
            conditions: Without ranges, as these environments cannot be varied.
        """
        return self._env(self._cls(self._task(config)), cameras, config.horizon)

    @override
    def expert(self, config: EnvConfig) -> GymExpert:
        return GymExpert(partial(self.environment, config, None, ()))

    @override
    def fingerprint(self, config: EnvConfig) -> dict[str, str]:
        settings, env = asdict(config), self.environment(config, None, ())
        del settings["object"]  # there is none
        settings["robot"] = _name(self._cls)
        simulated = simulation(env.env)
        model = model_bytes(simulated[0]) if simulated else b""
        found = environment_fingerprint(model, settings)
        if not env.hashes_code:
            return found
        package = type(env.env.unwrapped).__module__.partition(".")[0]
        sold = [f"{name} {version(name)}" for name in _distributions().get(package, [])]
        return found | {"world_sha256": source_hash(self._cls), "package": ", ".join(sold)}


_distributions = cache(packages_distributions)  # a second each time


def own_kind(robot: Path | str) -> GymKind | None:
    """Return the kind of a user's own world: of a file, or of an installed package's entry point;
    None if nothing has this name.
    """
    if isinstance(robot, Path):
        return GymKind(own_class(robot.absolute(), GymWorld, "manip_il.GymWorld (docs/new-env.md)"))
    for found in entry_points(group=WORLD_GROUP, name=robot):
        try:
            return GymKind(found.load())
        except Exception as error:
            raise UsageError(
                f"world {robot} of {found.value} cannot be imported: {checks.one_line(error)}"
            ) from error
    return None


def made(world: GymWorld) -> gymnasium.Env[Any, Any]:
    """Return a new environment of a world. Raises `UsageError` if `make` returns something else."""
    env: Any = world.make()
    if not (hasattr(env, "unwrapped") and hasattr(env, "action_space")):
        raise UsageError(
            f"{_at(world, 'make')}: returned {checks.shorten(env)}; expected a gymnasium.Env"
        )
    return env


def settings_of(world: GymWorld, env: gymnasium.Env[Any, Any] | None) -> dict[str, Any]:
    """Return rate [Hz] and horizon of a world, from its class or its environment.

    Args:
        world: The world.
        env: Its environment; None if the class gives both.

    Raises:
        UsageError: if neither gives one.
    """
    limit = getattr(getattr(env, "spec", None), "max_episode_steps", None)
    found = {
        "fps": world.fps or (env.metadata.get("render_fps", 0) if env is not None else 0),
        "horizon": world.horizon or limit or 0,
    }
    for name, value in found.items():
        if not value:
            raise UsageError(
                f"{_name(world)} has no {name}; give its class one, in"
                f" {inspect.getfile(type(world))}"
            )
    return found


def coordinates(*names: str) -> tuple[str, ...]:
    """Return the names of the coordinates of vectors."""
    return tuple(f"{name}.{axis}" for name in names for axis in "xyz")


def _name(world: GymWorld | type[GymWorld]) -> str:
    cls = world if isinstance(world, type) else type(world)
    return cls.name or re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", cls.__name__).lower()


def _names(world: GymWorld, key: str, count: int) -> tuple[str, ...]:
    """Return the names of the numbers of a key."""
    given = tuple(world.names.get(key, ()))
    if given and len(given) != count:
        raise UsageError(f"names of {key} of {_name(world)} are {len(given)}; expected {count}")
    return given or tuple(f"{key}_{place}" for place in range(count))


def _numbers(world: GymWorld, found: Mapping[str, Any], key: str) -> NDArray[np.float32]:
    """Return the numbers of a key of what `observe` returned, (k,)."""
    try:
        numbers = np.ravel(np.asarray(found.get(key, ()), np.float32))
    except (TypeError, ValueError):
        numbers = np.array(np.nan)
    if not np.isfinite(numbers).all():
        raise UsageError(
            f"{_at(world, 'observe')}: {key} is {checks.shorten(found[key])}; expected finite"
            " numbers"
        )
    return numbers


def _overrides(world: GymWorld | type[GymWorld], name: str) -> bool:
    cls = world if isinstance(world, type) else type(world)
    return getattr(cls, name) is not getattr(GymWorld, name)


def _at(world: GymWorld, method: str) -> str:
    """Return where a method of a world is written: file, line and name."""
    cls = type(world)
    if not _overrides(world, method):
        return f"{inspect.getfile(cls)} ({cls.__name__} has no {method})"
    code = inspect.unwrap(getattr(cls, method)).__code__
    return f"{code.co_filename}, line {code.co_firstlineno} ({method})"
