"""Losses of cloning and DAgger over the horizon, compared with the bounds of two theorems.

The theorems and equations are those of chapter 8 of A. Cai, An Introduction to Reinforcement
Learning (2025). Rewards are 0 to 1 per step; V is the expected sum of rewards over H steps, and eps
the expected share of the H steps of an episode in which the policy differs from the expert (Eq.
8.5).

Theorem 8.1: |V(expert) - V(policy)| <= H^2 eps, with eps in the expert's episodes (Ross & Bagnell
2010). Theorem 8.2: |V(expert) - V(policy)| <= H eps after O~(H^2) rounds of DAgger, with high
probability; eps is the error of the fits (Ross et al. 2011, Theorem 3.4, which has u H eps).

Measured for DAgger is what that theorem rests on: V(expert) - V(policy) <= u H eps, with eps in the
policy's own episodes; u is the largest cost of one wrong step if the expert then drives (Ross et
al. 2011, Theorem 2.2). Without u this holds if u <= 1. It has no absolute value: u only limits what
a policy can lose, and one may beat an expert that is not optimal by more.

Both follow from the performance difference lemma: V(expert) - V(policy) is the sum, over the steps
of the expert's episodes, of the policy's advantages (Eq. 8.6), each of which is at most H, and 0
where the two agree. It is also minus the sum, over the steps of the policy's episodes, of the
expert's advantages, each of which is at least -u, and 0 where the two agree.

Policies are fitted to trajectories; in states without data they take the worst action, as the
theorems allow.

The processes are small enough to be solved exactly, and differ in what one wrong step costs if the
expert then drives. A policy is an array (H, S): the probability of a wrong action at each step in
each state. Several policies are (..., H, S).
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from manip_il.mdp import F64
from manip_il.seeding import rng_for

PLACES = 100  # states that the expert visits
RIGHT, WRONG = 0, 1  # the expert's action in every state, and the other one
HORIZONS = (10, 20, 40, 80, 160, 320, 640)
# mean error of a policy times the horizon, small enough that the gap does not saturate
ERROR = 0.03
DRAWS = 16  # training sets drawn at each horizon
ROUNDS, MORE = 5, 20  # DAgger's rounds; each adds 1 / MORE of the initial number of trajectories
_ROUNDING = 1e-9
Learner = Literal["cloning", "DAgger"]


@dataclass(frozen=True, eq=False)
class Process:
    """S states and two actions; the expert always takes `RIGHT`. Rewards are 0 to 1 per step.

    Attributes:
        name: Name of the process.
        words: What a wrong action does.
        moves: Transition probabilities (action, from, to), uniform over the successors, (2, S, S).
        rewards: Reward of each action in each state, (2, S).
        start: Distribution of the first state, (S,).
        slopes: Powers of the horizon with which gap over error grows according to the theorems, for
            cloning and for DAgger.
    """

    name: str
    words: str
    moves: F64
    rewards: F64
    start: F64
    slopes: tuple[float, float]

    @property
    def states(self) -> int:
        """Number of states."""
        return len(self.start)

    def wrong_costs(self, horizon: int) -> F64:
        """Return the cost of one wrong action at each step in each state if the expert then
        drives, (H, S).
        """
        found, after = np.empty((horizon, self.states)), np.zeros(self.states)
        for t in range(horizon - 1, -1, -1):
            right, wrong = self.rewards + self.moves @ after
            found[t], after = right - wrong, right
        return found

    def recoverability(self, horizon: int) -> float:
        """Return u: the largest cost of one wrong action, over the states that some policy
        reaches.
        """
        uniform = np.full((horizon, self.states), 0.5)
        return float(self.wrong_costs(horizon)[self.visits(uniform) > 0].max())

    def visits(self, policy: F64) -> F64:
        """Return the distribution of the state at each step, (..., H, S), under policies (...,
        H, S).
        """
        found = np.empty(policy.shape)
        now = np.broadcast_to(self.start, (*policy.shape[:-2], self.states))
        for t in range(policy.shape[-2]):
            found[..., t, :] = now
            wrong = now * policy[..., t, :]
            now = (now - wrong) @ self.moves[RIGHT] + wrong @ self.moves[WRONG]
        return found

    def seen(self, policy: F64, count: int, rng: np.random.Generator) -> NDArray[np.bool_]:
        """Draw which states are visited by at least one of `count` trajectories of each policy.

        The probability of a visit, 1 - (1 - p)^count, is exact for every state and step; the draws
        are independent of each other.

        Args:
            policy: Probability of a wrong action of each policy, (..., H, S).
            count: Number of trajectories per policy.
            rng: Draws the visits.

        Returns:
            Whether a state is visited at a step, (..., H, S).
        """
        return rng.random(policy.shape) >= (1 - self.visits(policy)) ** count


def _walk(back: bool) -> tuple[F64, F64, F64]:
    """A random walk over `PLACES` states, and one state beside them that a wrong action leads to.

    back: whether the right action leads back from there.
    """
    moves = np.zeros((2, PLACES + 1, PLACES + 1))
    rewards = np.zeros((2, PLACES + 1))
    beside = PLACES
    moves[RIGHT, :PLACES, :PLACES] = 1 / PLACES
    moves[WRONG, :, beside] = 1.0
    moves[RIGHT, beside, :PLACES] = back / PLACES
    moves[RIGHT, beside, beside] = not back
    rewards[RIGHT, :PLACES] = 1.0
    return moves, rewards, np.append(np.full(PLACES, 1 / PLACES), 0.0)


def _ring() -> tuple[F64, F64, F64]:
    """A ring of `PLACES` states, all visited by the expert: right actions move 1 or 2 forward,
    wrong ones back.
    """
    on = (np.roll(np.eye(PLACES), 1, axis=1) + np.roll(np.eye(PLACES), 2, axis=1)) / 2
    rewards = np.stack([np.ones(PLACES), np.zeros(PLACES)])
    return np.stack([on, on.T]), rewards, np.full(PLACES, 1 / PLACES)


PROCESSES = (
    Process(
        "mended walk",
        "leads off the path, to which the expert returns in one step",
        *_walk(True),
        (2, 1),
    ),
    Process("tightrope", "is a fall without recovery", *_walk(False), (2, 2)),
    Process("visited chain", "leads to another state that the expert visits", *_ring(), (1, 1)),
)


@dataclass(frozen=True, eq=False)
class LossCurve:
    """Losses of a learner at each of h horizons, for each of D draws of its training data.

    Attributes:
        problem: Name of the process.
        learner: The method that fitted the policies.
        horizons: The h horizons [steps].
        errors: Expected share of the steps in which the policy errs (Eq. 8.5), (h, D).
        gaps: The expert's value V minus the policy's, (h, D).
        bounds: Upper bounds on the gaps by the learner's theorem, (h, D).
    """

    problem: str
    learner: Learner
    horizons: tuple[int, ...]
    errors: F64
    gaps: F64
    bounds: F64

    @property
    def ratios(self) -> F64:
        """Mean gap over mean error at each horizon, (h,)."""
        return self.gaps.mean(axis=1) / self.errors.mean(axis=1)

    @property
    def slope(self) -> float:
        """Exponent with which gap over error grows with the horizon."""
        return float(np.polyfit(np.log(self.horizons), np.log(self.ratios), 1)[0])

    @property
    def above(self) -> int:
        """Number of policies whose gap exceeds its bound by more than rounding."""
        return int((self.gaps > self.bounds * (1 + _ROUNDING) + _ROUNDING).sum())

    def to_json(self) -> dict[str, Any]:
        """Return the curve as JSON."""
        losses = {name: getattr(self, name).tolist() for name in ("errors", "gaps", "bounds")}
        return vars(self) | losses | {"slope": self.slope, "above": self.above}


def curves(
    process: Process, horizons: Sequence[int] = HORIZONS, draws: int = DRAWS
) -> Iterator[LossCurve]:
    """Fit cloning and DAgger on one process at each horizon, and measure their losses.

    Args:
        process: The process.
        horizons: Numbers of steps of an episode.
        draws: Number of training sets at each horizon.

    Yields:
        The loss curve of cloning, then that of DAgger.
    """
    found: dict[Learner, list[F64]] = {"cloning": [], "DAgger": []}
    for horizon in horizons:
        for learner, policies in _fitted(process, horizon, draws).items():
            found[learner].append(losses_of(process, learner, policies))
    for learner, losses in found.items():
        yield LossCurve(process.name, learner, tuple(horizons), *np.stack(losses, axis=1))


def losses_of(process: Process, learner: Learner, policies: F64) -> F64:
    """Return the error and gap of each policy, and the bound of the learner's theorem.

    The error is measured in the states of the expert (cloning) or of the policy (DAgger). The gap
    is the cost of the policy's wrong actions in the states that it visits, by the performance
    difference lemma.

    Args:
        process: The process.
        learner: The method that fitted the policies; it decides which theorem applies.
        policies: Probability of a wrong action of each policy, (B, H, S).

    Returns:
        Error, gap and bound in this order, (3, B).
    """
    horizon, own = policies.shape[1], process.visits(policies) * policies
    gaps = (own * process.wrong_costs(horizon)).sum(axis=(1, 2))
    wrong = (
        process.visits(np.zeros((horizon, process.states))) * policies
        if learner == "cloning"
        else own
    )
    errors = wrong.sum(axis=(1, 2)) / horizon
    bounds = (
        cloning_bound(horizon, errors)
        if learner == "cloning"
        else dagger_bound(horizon, errors, process.recoverability(horizon))
    )
    return np.stack([errors, gaps, bounds])


def cloning_bound[T: (float, F64)](horizon: int, error: T) -> T:
    """Return H^2 eps, Theorem 8.1's bound on the gap, for errors in the expert's episodes."""
    return horizon**2 * error


def dagger_bound[T: (float, F64)](horizon: int, error: T, u: float) -> T:
    """Return u H eps, the bound on the gap for errors in the policy's own episodes.

    Args:
        horizon: The horizon H [steps].
        error: The error eps of each policy.
        u: Largest cost of one wrong action if the expert then drives.
    """
    return u * horizon * error


def clone(process: Process, seen: NDArray[np.bool_]) -> F64:
    """Return policies (..., H, S) fitted to labels in the seen states (..., H, S): right in these,
    wrong elsewhere.

    In states in which no action is worse than the expert's, such as after a fall, the policies act
    as the expert.
    """
    return np.where(seen | (process.wrong_costs(seen.shape[-2]) <= 0), 0.0, 1.0)


def dagger(process: Process, seen: NDArray[np.bool_], count: int, rng: np.random.Generator) -> F64:
    """Return DAgger's policies.

    Each is the policy of the round with the fewest errors in its own states (Definition 8.2).

    Args:
        process: The process.
        seen: Whether states have labels from the expert's own trajectories, (B, H, S).
        count: Trajectories per round.
        rng: Draws the trajectories, see `Process.seen`.

    Returns:
        Probability of a wrong action of each policy, (B, H, S).
    """
    best, least = np.empty(seen.shape), np.full(len(seen), np.inf)
    for round_ in range(ROUNDS + 1):
        policy = clone(process, seen)
        errors = (process.visits(policy) * policy).sum(axis=(1, 2))
        better = errors < least
        best[better], least[better] = policy[better], errors[better]
        if round_ < ROUNDS:
            seen = seen | process.seen(policy, count, rng)
    return best


def _fitted(process: Process, horizon: int, draws: int) -> dict[Learner, F64]:
    """Cloning's and DAgger's policies from equally many trajectories, which leave about ERROR /
    H of states unseen.
    """
    rng = rng_for(0, f"trajectories of {horizon} steps, {process.name}")
    count = int(np.ceil(PLACES * np.log(horizon / ERROR)))
    first = round(count / (1 + ROUNDS / MORE))
    expert = np.zeros((draws, horizon, process.states))
    for_clone, for_dagger = (process.seen(expert, number, rng) for number in (count, first))
    return {
        "cloning": clone(process, for_clone),
        "DAgger": dagger(process, for_dagger, first // MORE, rng),
    }
