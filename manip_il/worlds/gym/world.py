"""An environment of gymnasium and its expert, as a user describes them in one class."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64, Label
from manip_il.sim.config import CameraConfig

AGENT = "agent_pos"  # gymnasium's name, in LeRobot's environments, of `observation.state`
AROUND = "environment_state"


class GymWorld:
    """Base class of a world of one's own: an environment with gymnasium's interface and its expert.

    Only `make` and `act` are required. In a MuJoCo environment, cameras draw it and states are
    restored without another line.

    Attributes:
        name: Its name in datasets; by default the class's, in lower case.
        tasks: Names of its tasks, if there are several; `task` is the chosen one.
        groups: Names for several of its tasks together.
        instruction: The task in words.
        fps: Control steps per second; by default the environment's `render_fps`.
        horizon: Most control steps of an episode; by default the environment's own limit.
        phases: Names of the expert's phases, for labels that give one; the first means none.
        cameras: Names of its cameras; by default those of the MuJoCo model, else "render" if
            `render` of the environment returns pictures.
        names: Names of the numbers of `agent_pos`, `environment_state` and `action`, where given.
        recurrent: Whether the expert keeps memory within an episode. Its labels then cannot be
            computed again, and it is asked in every step.
        task: The chosen task.
    """

    name: str = ""
    tasks: tuple[str, ...] = ()
    groups: Mapping[str, tuple[str, ...]] = {}  # read alone
    instruction: str = ""
    fps: int = 0
    horizon: int = 0
    phases: tuple[str, ...] = ("none", "act")
    cameras: tuple[str, ...] | None = None
    names: Mapping[str, tuple[str, ...]] = {}  # read alone
    recurrent: bool = False

    def __init__(self, task: str = ""):
        self.task = task

    def make(self) -> gymnasium.Env[Any, Any]:
        """Return a new environment; its actions are a flat `Box`."""
        raise NotImplementedError

    def reset(self, env: Any, seed: int) -> tuple[Any, Mapping[str, Any]]:
        """Begin the episode of a seed.

        Args:
            env: The environment that `make` returned.
            seed: The episode's seed, below 2**32.

        Returns:
            What the environment's `reset` returns: its observation and `info`.
        """
        return env.reset(seed=seed)

    def observe(self, env: Any, seen: Any) -> Mapping[str, Any]:
        """Return what a policy gets.

        Args:
            env: The environment.
            seen: The observation that its last `step` or `reset` returned.

        Returns:
            `agent_pos`, the robot's own numbers, and `environment_state`, privileged ones, if
            there are any. By default these keys of `seen`, or all of it as `agent_pos`.
        """
        return seen if isinstance(seen, Mapping) else {AGENT: seen}

    def solved(self, env: Any, info: Mapping[str, Any]) -> bool:
        """Return whether the task is solved after a step, whose `info` is given."""
        return bool(info.get("is_success", info.get("success", False)))

    def act(self, env: Any, seen: Any) -> Label | NDArray[Any]:
        """Return what the expert does in the present state; it must not change the environment.

        Args:
            env: The environment.
            seen: The observation that its last `step` or `reset` returned.

        Returns:
            An action, (n,), or a `Label`, which can also say that there is no sound action, and
            why.
        """
        raise NotImplementedError

    def progress(self, env: Any, info: Mapping[str, Any]) -> float:
        """Return the share of the task that is done, 0 to 1, for `patience`; by default unknown."""
        raise NotImplementedError

    def text(self, env: Any) -> str:
        """Return the task of this episode in words; by default `instruction`."""
        return self.instruction

    def positions(self, env: Any) -> Mapping[str, F64]:
        """Return true positions (3,) [m], for reports: of `hand`, of `object`, and of others."""
        return {}

    def render(self, env: Any, camera: str, cameras: CameraConfig) -> NDArray[np.uint8] | None:
        """Return a picture of the present state.

        Args:
            env: The environment.
            camera: One of its cameras.
            cameras: Size of the picture.

        Returns:
            The picture, (height, width, 3); None for the one of the model's camera, or of the
            environment's own `render`.
        """
        return None

    def state(self, env: Any) -> F64:
        """Return all numbers that the future depends on, (p,), except the observation.

        By default, and in a MuJoCo environment alone: the integration state, what episodes change
        in the model, and every number and array among the environment's attributes.
        """
        raise NotImplementedError

    def restore(self, env: Any, state: F64) -> None:
        """Bring an environment into a state.

        Args:
            env: The environment.
            state: What `state` returned, (p,).
        """
        raise NotImplementedError
