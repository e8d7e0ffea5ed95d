"""From states that a learner visited, the expert shows the way in a copy of the simulator; the learner goes on."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

from manip_il.engine.drivers import ExpertDriver
from manip_il.mdp import State, Transition
from manip_il.rollout import Labeller, Rules, rollout
from manip_il.sim.env import ManipEnv


class Brancher:
    """Runs the expert for `steps` control steps from any state of one scene."""

    def __init__(self, env: ManipEnv, expert: Labeller, steps: int):
        self._env, self._expert, self._rules = env, expert, Rules(steps)

    def from_labelled(self, frames: Iterable[Transition]) -> Iterator[Transition]:
        """Yield the branches of all frames that have a sound label, one after the other; each ends with `done`."""
        for frame in frames:
            if frame.label is not None and frame.label.valid:
                yield from self.branch(frame.seed, frame.state)

    def branch(self, seed: int, state: State) -> Iterator[Transition]:
        """What the expert does from `state` on; states, pictures and labels are of the copy."""
        return rollout([_Restored(self._env, state)], [seed], ExpertDriver(), self._rules, self._expert)


class _Restored:
    """An environment whose episodes begin in a given state."""

    def __init__(self, env: ManipEnv, state: State):
        self._env, self._state = env, state
        self.advance, self.observe, self.get_state = env.advance, env.observe, env.get_state

    @property
    def progress(self) -> float:
        return self._env.progress

    @property
    def solved(self) -> bool:
        return self._env.solved

    def start(self, seed: int) -> None:
        self._env.set_state(self._state)
