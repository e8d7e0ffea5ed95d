"""Episodes in a window as they happen, and the window's sliders as a driver."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from manip_il.collect.environments import env_spec
from manip_il.collect.rollout import Act, Turn
from manip_il.mdp import Actor, Transition
from manip_il.sim.env import ManipEnv
from manip_il.sim.window import Window

F64 = NDArray[np.float64]


class WindowScreen:
    """MuJoCo's viewer of one environment, with its phase and progress; objects can be pulled with the mouse.

    sliders: its control sliders drive. Raises `RenderError` where there is no display.
    """

    def __init__(self, env: ManipEnv, *, sliders: bool = False):
        self._env, self._phases = env, env_spec(env.config).phases
        self._window = Window(env.config, sliders=sliders)
        self.act = slider_actions(self._window, env) if sliders else None

    def add(self, step: Transition) -> bool:
        """Show the world after a step, in real time; returns False once the window is closed."""
        phase = f"  {self._phases[step.label.phase]}" if step.label else ""
        solved = "  solved" if step.success else ""
        text = f"seed {step.seed}  step {step.step + 1}{phase}  progress {100 * self._env.progress:.0f} %{solved}"
        self._window.show(self._env.data, self._env.looks, text)
        self._window.pull(self._env.data)
        return self._window.is_open

    def close(self) -> None:
        """Close the window."""
        self._window.close()


def slider_actions(window: Window, env: ManipEnv) -> Act:
    """Return a driver that executes what the control sliders of a window say, joint targets and gripper command (n,).

    An episode begins with those that it starts from.
    """

    def act(turns: Sequence[Turn]) -> list[tuple[F64, Actor]]:
        scene, before = env.scene, env.data.ctrl
        [turn] = turns
        commands = before if turn.step == 0 else window.commands
        opening = scene.gripper.commanded(commands[scene.gripper.ctrl], before[scene.gripper.ctrl])
        return [(scene.actions.join(commands[scene.arm_ctrl], opening), Actor.LEARNER)]

    return act


def outcome(step: Transition) -> str:
    """Return how the episode ended whose last step this is."""
    return f"seed {step.seed}: {'solved' if step.success or step.state.ever else 'not solved'}, {step.step + 1} steps"
