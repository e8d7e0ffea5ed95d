"""GAIL and AIRL on gymnasium's Pendulum-v1 and CartPole-v1, as shares of the expert's return.

python benchmarks/adversarial.py [--seeds 10] [--env NAME] [--algorithm gail|airl] [--quick]

The loops are those of `manip_il.chapter.learning`, with the same discriminators, PPO and network as
for robots. Every training seed begins with a new policy and its own demonstrations; its last policy
acts without exploring on 100 episodes, the same for all. With the mean returns R, the share is

    (R of the policy - R of random actions) / (R of the expert - R of random actions)

as in the imitation library's table (Gleave et al., imitation: Clean imitation learning
implementations, 2022). Random actions are uniform. Limits on the interquartile mean over seeds, in
each environment and in both together (Agarwal et al., Deep reinforcement learning at the edge of
the statistical precipice, 2021): 0.95 for GAIL, 0.90 for AIRL.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import gymnasium
import numpy as np
import torch
from _machine import describe_machine
from numpy.typing import NDArray
from scipy.stats import trim_mean

from manip_il.chapter.config import DiscriminatorConfig, PPOConfig
from manip_il.chapter.discriminators import Discriminator
from manip_il.chapter.episodes import Demonstrations, Lockstep
from manip_il.chapter.learning import imitate
from manip_il.chapter.ppo import Learner, seed_generators
from manip_il.learn.network import MLPNetwork, NetworkConfig, fit_statistics, threads
from manip_il.seeding import rng_for, stream_base, stream_seeds

F32, F64 = NDArray[np.float32], NDArray[np.float64]
Acting = Callable[[F32], F32]  # raw inputs (B, d) to raw targets (B, 1)
LIMITS = {"gail": 0.95, "airl": 0.90}
# Pendulum-v1's [N m], [m/s^2]; angle at which the expert balances [rad]
_TORQUE, _GRAVITY, _TOP = 2.0, 10.0, 0.5


class Pendulum:
    """Pendulum-v1: observes cos and sin of the angle from the top, and the speed [rad/s].

    Targets are torques [N m].

    Every episode has 200 steps; nothing ends or solves it.
    """

    name, steps, ended, solved = "Pendulum-v1", 200, False, False

    def __init__(self) -> None:
        self._env = gymnasium.make(self.name).unwrapped

    def start(self, seed: int) -> None:
        seen, _ = self._env.reset(seed=seed)
        self._seen, self.total = np.asarray(seen, np.float32), 0.0

    def inputs(self) -> F32:
        return self._seen

    def advance(self, action: F64) -> None:
        seen, reward, *_ = self._env.step(action)
        self._seen, self.total = np.asarray(seen, np.float32), self.total + float(reward)

    @staticmethod
    def expert(inputs: F32) -> F32:
        """Pump energy up to that of resting at the top, and balance there by feedback (Astrom &
        Furuta, 2000).
        """
        angle, speed = np.arctan2(inputs[:, 1], inputs[:, 0]), inputs[:, 2]
        energy = speed**2 / 6 + _GRAVITY / 2 * (inputs[:, 0] - 1)  # [J], 0 at the top
        pumping = np.where(speed >= 0, -1.0, 1.0) * energy * 10
        balancing = -(15.0 * angle + 4.0 * speed)
        return (
            np.where(np.abs(angle) < _TOP, balancing, pumping)
            .clip(-_TORQUE, _TORQUE)
            .astype(np.float32)[:, None]
        )

    @staticmethod
    def random(inputs: F32, rng: np.random.Generator) -> F32:
        return rng.uniform(-_TORQUE, _TORQUE, (len(inputs), 1)).astype(np.float32)


class CartPole:
    """CartPole-v1: observes position, velocity, angle and angular velocity.

    The sign of a target is the push direction.

    An episode has 500 steps, each with a reward of 1; a fall ends it early, in a state that no
    demonstration has.
    """

    name, steps = "CartPole-v1", 500

    def __init__(self) -> None:
        self._env = gymnasium.make(self.name).unwrapped

    def start(self, seed: int) -> None:
        seen, _ = self._env.reset(seed=seed)
        self._seen, self.total, self.ended = np.asarray(seen, np.float32), 0.0, False

    def inputs(self) -> F32:
        return self._seen

    def advance(self, action: F64) -> None:
        seen, reward, self.ended, *_ = self._env.step(int(action[0] > 0))
        self._seen, self.total = np.asarray(seen, np.float32), self.total + float(reward)

    @property
    def solved(self) -> bool:
        return not self.ended

    @staticmethod
    def expert(inputs: F32) -> F32:
        """Push against the weighted sum of errors, as a linear controller does: 1 or -1."""
        return np.where(inputs @ np.array([0.3, 0.7, 10.0, 2.0], np.float32) > 0, 1.0, -1.0).astype(
            np.float32
        )[:, None]

    @staticmethod
    def random(inputs: F32, rng: np.random.Generator) -> F32:
        return rng.choice(np.array([-1.0, 1.0], np.float32), (len(inputs), 1))


ENVIRONMENTS: dict[str, type[Pendulum] | type[CartPole]] = {
    one.name: one for one in (Pendulum, CartPole)
}


@dataclass(frozen=True, kw_only=True)
class Settings:
    """Hyperparameters of a run, named as in `LearningConfig`. demonstrations: episodes of
    `episode_steps`.
    """

    steps: int
    episodes: int = 16
    episode_steps: int = 200
    log_std: float = -0.5
    demonstrations: int = 20
    ppo: PPOConfig = field(default_factory=PPOConfig)
    discount: float = 0.9
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)


# All other values are the defaults for robots. These were chosen on training seeds from 100 on.
SETTINGS = {
    "Pendulum-v1": Settings(steps=100_000, ppo=PPOConfig(lr=2e-3, minibatches=8)),
    "CartPole-v1": Settings(steps=30_000, ppo=PPOConfig(lr=1e-3, minibatches=8)),
}
SHAPE = NetworkConfig(width=64, depth=2, loss="gaussian", action_space="joint_target")
_QUICK = {"steps": 1_000, "episode_steps": 20, "demonstrations": 2}


class Run:
    """The steps that `imitate` calls, as in `Agent`, with nothing on disk."""

    def __init__(self, algorithm: str, name: str, settings: Settings, seed: int):
        self._gamma = settings.discount if algorithm == "airl" else None
        self.simulated, self.metrics = 0, dict[str, float]()
        self._settings, self._seed, self._number = settings, seed, 0
        shown = demonstrations(name, settings, seed)
        seed_generators(self._stream("weights"))
        self._network = MLPNetwork(shown.inputs[0].shape[1], 1, SHAPE)
        self._network.set_statistics(fit_statistics(*shown.stacked, SHAPE.loss))
        episodes = [ENVIRONMENTS[name]() for _ in range(settings.episodes)]
        self._envs = Lockstep(episodes, self._network, settings.episode_steps)
        self._learner = Learner(self._network, settings.ppo, self._envs, settings.log_std)
        self._expert = shown.padded(settings.episode_steps, self._network)

    def discriminator(self) -> Discriminator:
        seed_generators(self._stream("discriminator"))
        return Discriminator(self._settings.discriminator, self._network, self._gamma)

    def agent(self) -> Run:
        return self

    def begin(self, agent: Run) -> Iterator[Any]:
        return iter(())

    def rollouts(self) -> None:
        count = self._settings.episodes
        self._number += 1
        seed_generators(self._stream("rollouts"))
        self._rows = self._learner.collect(
            stream_seeds("reinforcement", (self._number + 1) * count, self._seed)[-count]
        )
        self.simulated += self._envs.simulated

    def discriminate(self, d: Discriminator) -> F32:
        rng = rng_for(self._stream("discriminator"), "batches")
        expert = self._learner.explored(self._expert, rng)
        density, own = self._learner.log_prob(expert), self._learner.log_prob(self._rows)
        self.metrics = d.fit(expert, self._rows, (density, own), rng)
        return d.reward(self._rows, own)

    def improve(self, rewards: F32) -> None:
        remaining = max(0.0, 1.0 - self.simulated / self._settings.steps)
        seed_generators(self._stream("updates"))
        self.metrics |= self._learner.improve(rewards, remaining=remaining)

    def finish(self, agent: Run) -> dict[str, float]:
        return self.metrics

    def acts(self, inputs: F32) -> F32:
        """Return the policy's targets (B, 1) without exploration."""
        return self._network.act(torch.from_numpy(inputs)).numpy()

    def _stream(self, purpose: str) -> int:
        """Return a seed for one purpose in an iteration."""
        return int(
            rng_for(stream_base("reinforcement", self._seed) + self._number, purpose).integers(
                2**63
            )
        )


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--seeds", type=int, default=10, help="training seeds, from 0 on")
    parser.add_argument("--env", choices=[*ENVIRONMENTS], help="by default both")
    parser.add_argument("--algorithm", choices=[*LIMITS], help="by default both")
    parser.add_argument(
        "--quick", action="store_true", help="a few of each: shows that it runs, measures nothing"
    )
    options = parser.parse_args()
    if options.seeds < 1:
        parser.error(f"--seeds is {options.seeds}; expected at least 1")
    names = [options.env] if options.env else [*ENVIRONMENTS]
    seeds = range(2 if options.quick else options.seeds)
    print(describe_machine())
    with threads(1):
        ends = {name: references(name, options.quick) for name in names}
        missed = [
            measure(algorithm, ends, seeds, quick=options.quick)
            for algorithm in ([options.algorithm] if options.algorithm else LIMITS)
        ]
    return int(any(missed) and not options.quick)


def measure(
    algorithm: str, ends: dict[str, tuple[float, float]], seeds: Sequence[int], *, quick: bool
) -> bool:
    """Print shares per environment and overall.

    Return whether a limit was missed. ends: see `references`.
    """
    shares: dict[str, list[float]] = {}
    for name, (random, expert) in ends.items():
        begin, settings = time.process_time(), replace(SETTINGS[name], **(_QUICK if quick else {}))
        returns = [
            mean_return(name, trained(algorithm, name, settings, seed), quick) for seed in seeds
        ]
        seconds = (time.process_time() - begin) / len(seeds)
        shares[name] = [(one - random) / (expert - random) for one in returns]
        print(
            f"{algorithm}, {name}: return of random actions {random:.1f}, of the expert"
            f" {expert:.1f}"
        )
        print(
            f"   {settings.demonstrations} demonstrations, {settings.steps:,} steps, {seconds:.0f}"
            " s a seed"
        )
        print("   shares of seeds: " + " ".join(f"{one:.3f}" for one in shares[name]))
    together = [one for several in shares.values() for one in several]
    return any(
        [
            _missed(algorithm, name, several)
            for name, several in {**shares, "together": together}.items()
        ]
    )


def _missed(algorithm: str, name: str, shares: Sequence[float]) -> bool:
    """Print the interquartile mean of shares beside its limit; return whether it is below."""
    middle, limit = float(trim_mean(shares, 0.25)), LIMITS[algorithm]
    low, high = np.percentile(shares, [25, 75])
    print(
        f"{algorithm}, {name}: interquartile mean {middle:.3f} ({low:.3f} to {high:.3f}), limit"
        f" {limit:.2f}"
    )
    return middle < limit


def trained(algorithm: str, name: str, settings: Settings, seed: int) -> Acting:
    """Return the last policy of a run, acting without exploration."""
    run: Any = Run(algorithm, name, settings, seed)
    options: Any = settings
    for _ in imitate(run, options):
        pass
    return run.acts


def references(name: str, quick: bool) -> tuple[float, float]:
    """Return the mean returns of random actions and of the expert."""
    made, rng = ENVIRONMENTS[name], rng_for(stream_base("test"), name)
    return mean_return(name, lambda inputs: made.random(inputs, rng), quick), mean_return(
        name, made.expert, quick
    )


def mean_return(name: str, acting: Acting, quick: bool) -> float:
    """Return the mean return over whole episodes, the same for all policies."""
    _, _, returns = play(
        name, acting, stream_seeds("test", 2 if quick else 100), ENVIRONMENTS[name].steps
    )
    return float(returns.mean())


def demonstrations(name: str, settings: Settings, seed: int) -> Demonstrations:
    """Return episodes of the expert."""
    seeds = stream_seeds("demonstrations", settings.demonstrations, seed)
    inputs, targets, _ = play(name, ENVIRONMENTS[name].expert, seeds, settings.episode_steps)
    return Demonstrations(tuple(inputs.swapaxes(0, 1)), tuple(targets.swapaxes(0, 1)), None)


def play(name: str, acting: Acting, seeds: Sequence[int], steps: int) -> tuple[F32, F32, F64]:
    """Return inputs (T, B, d) and targets (T, B, 1) of B episodes, and their returns (B,)."""
    episodes = [ENVIRONMENTS[name]() for _ in seeds]
    for episode, seed in zip(episodes, seeds, strict=True):
        episode.start(seed)
    inputs, targets = list[F32](), list[F32]()
    for _ in range(steps):
        inputs.append(np.stack([one.inputs() for one in episodes]))
        targets.append(acting(inputs[-1]))
        for episode, target in zip(episodes, targets[-1], strict=True):
            if not episode.ended:
                episode.advance(target)
    return np.stack(inputs), np.stack(targets), np.array([one.total for one in episodes])


if __name__ == "__main__":
    sys.exit(main())
