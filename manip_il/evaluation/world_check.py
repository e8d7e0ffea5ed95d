"""Does a world keep the contract of `manip_il.worlds.contract`, and how good is its expert?"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np

from manip_il.collect.job import RolloutJob
from manip_il.data.schema import LABEL_VALID
from manip_il.evaluation.intervals import Proportion
from manip_il.mdp import F64, Episode
from manip_il.seeding import rng_for, stream_seeds
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import Environment
from manip_il.worlds.table import make_env, make_expert

_STEPS = 10  # control steps that a restored state goes on
_AT = 12  # control steps of the expert before a state is restored
_SEEDS = 5  # episodes in which starts, states and labels are compared


@dataclass(frozen=True)
class Check:
    """One part of the contract.

    Attributes:
        what: The part.
        found: What was measured.
        advice: What to change if it is not kept; "" if it is.
    """

    what: str
    found: str
    advice: str = ""

    def __str__(self) -> str:
        return f"{'ok ' if not self.advice else 'NOT'} {self.what}: {self.found}" + (
            f"; {self.advice}" if self.advice else ""
        )


def check_world(config: EnvConfig, episodes: int, step: Callable[[], None]) -> Iterator[Check]:
    """Yield the checks of a world, in the order in which they are made.

    Args:
        config: Settings of the environment, complete.
        episodes: Episodes of the expert.
        step: Called after each of them.
    """
    env, other = make_env(config), make_env(config)
    seeds = stream_seeds("certificate", max(episodes, _SEEDS))
    yield _starts(env, other, seeds[:_SEEDS])
    if "restored" in env.spec.can:
        yield _restored(config, env, other, seeds[:_SEEDS])
    else:
        yield Check(
            "states", "cannot be restored, so relabel, redraw and branches do not work with it"
        )
    if env.spec.expert == "stateless":
        yield _labels(config, env, other, seeds[:_SEEDS])
    else:
        yield Check("labels", "the expert keeps memory, as it says, so it is asked in every step")
    yield from _episodes(config, seeds[:episodes], step)


def _starts(env: Environment, other: Environment, seeds: range) -> Check:
    """Check that the same seed gives the same start, after another episode and in another
    environment, as far as it is seen in the first steps.
    """
    for seed in seeds:
        first = _episode(env, seed)
        env.start(seed + 1)
        for where, again in (("again", env), ("in another environment", other)):
            if not np.array_equal(first, _episode(again, seed)):
                return Check(
                    "starts",
                    f"seed {seed} begins differently when it begins {where}",
                    "draw everything from the seed that `reset` gets",
                )
    return Check("starts", f"the same seed gives the same start ({len(seeds)} seeds)")


def _restored(config: EnvConfig, env: Environment, other: Environment, seeds: range) -> Check:
    """Check that restored states go on as the states that they were read from."""
    for seed in seeds:
        _drive(config, env, seed)
        other.start(seed + 1)
        other.set_state(env.get_state())
        for number in range(_STEPS):
            action = _action(env, seed, number)
            before = env.step(action)
            after = other.step(action)
            one, two = _whole(env), _whole(other)
            if before[1:] != after[1:] or not np.array_equal(one, two):
                return Check(
                    "states",
                    f"seed {seed} goes on differently {number + 1} steps after it was restored"
                    f" (by up to {abs(one - two).max():.2g})",
                    "let `state` and `restore` hold everything that the future depends on",
                )
            if before.solved or before.ended:
                break
    size = env.spec.sim_state_size
    return Check("states", f"a restored state goes on the same, bit for bit ({size} numbers)")


def _labels(config: EnvConfig, env: Environment, other: Environment, seeds: range) -> Check:
    """Check that labels depend on the state alone, and that labelling changes nothing."""
    expert = make_expert(config)
    for seed in seeds:
        _drive(config, env, seed)
        before, state = _whole(env), env.get_state()
        labels = [expert.label(state, env)]
        if not np.array_equal(before, _whole(env)):
            return Check(
                "labels",
                f"the expert changes the environment (seed {seed})",
                "let it only read, or plan in an environment of its own",
            )
        _drive(config, other, seed)
        labels.append(expert.label(state, other))
        if "restored" in env.spec.can:
            other.start(seed + 1)
            other.set_state(state)
            labels += [expert.label(state, other), expert.label(state)]
        if any(not np.array_equal(labels[0].action, one.action) for one in labels):
            return Check(
                "labels",
                f"the expert answers differently in the same state (seed {seed})",
                "let it depend on `seen` and the state alone (poses in MuJoCo's data are those"
                " before the last physics step), or say `recurrent = True`",
            )
    return Check("labels", "a function of the state; labelling changes nothing")


def _episodes(config: EnvConfig, seeds: range, step: Callable[[], None]) -> Iterator[Check]:
    """Yield the expert's success, and the time of a step with its label."""
    found = list[Episode]()
    began = time.perf_counter()
    for episode in RolloutJob(config, hold=0).run(seeds):
        found.append(episode)
        step()
    spent = time.perf_counter() - began
    if not found:
        return
    success = Proportion.of([episode.success for episode in found])
    steps = [len(episode) for episode in found]
    invalid = sum(int((episode.columns[LABEL_VALID] == 0).sum()) for episode in found)
    yield Check(
        "expert",
        f"solves {success} of {len(found)} episodes, in {np.median(steps):.0f} steps;"
        f" {invalid} labels not valid",
        "" if success.successes else "a policy learns nothing from it",
    )
    yield Check("time", f"{1000 * spent / sum(steps):.2f} ms a step with its label")


def _drive(config: EnvConfig, env: Environment, seed: int) -> None:
    """Let the expert drive the first steps of an episode, but not to its end."""
    expert = make_expert(config)
    env.start(seed)
    for _ in range(rng_for(seed, "check").integers(_AT)):
        env.observe()
        outcome = env.step(expert.label(env.get_state(), env).action)
        if outcome.solved or outcome.ended:
            env.start(seed)
            break
    env.observe()


def _action(env: Environment, seed: int, number: int) -> F64:
    """Return an action near the measured state, drawn from a seed and a number, (n,)."""
    return env.actions.random_near(env.observe().state, rng_for(seed, f"check {number}"))


def _episode(env: Environment, seed: int) -> F64:
    """Return what is seen at the start of an episode and in its first steps, (m,)."""
    env.start(seed)
    found = []
    for number in range(_STEPS):
        seen = env.observe()
        found += [seen.state, seen.environment_state]
        if env.step(_action(env, seed, number)).ended:
            break
    return np.concatenate(found)


def _whole(env: Environment) -> F64:
    """Return everything that can be read of an environment, (m,)."""
    seen = env.observe()
    numbers = np.concatenate([seen.state, seen.environment_state])
    return np.append(numbers.astype(np.float64), env.get_state().to_vector())
