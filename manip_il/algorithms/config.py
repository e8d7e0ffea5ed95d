"""Options of one run of an algorithm: the driver, the data, and all of it checked against each other."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.errors import UnknownName, UsageError
from manip_il.learn.fit_config import FitConfig, MLPOptions
from manip_il.option import option
from manip_il.sim.config import CameraConfig, EnvConfig
from manip_il.stock.table import ROBOT as STOCK

if TYPE_CHECKING:  # help of `manip-il dagger` reads the options, without numpy
    import numpy as np
    from numpy.typing import NDArray

    from manip_il.collect.query import Query
    from manip_il.sim.conditions import Condition

    F64 = NDArray[np.float64]

SCHEDULES = {
    "constant": "constant:0.0 lets the learner drive alone from round 1 on (the paper's parameter-free choice)",
    "linear": "linear:5 falls evenly from 1 in round 0 to 0 in round 5",
    "exponential": "exponential:0.5 is 0.5 to the power of the round",
}


@dataclass(frozen=True)
class BetaSchedule:
    """`kind:parameter`, as in `constant:0`, `linear:5`, `exponential:0.5`. Round 0 is the expert's own: beta is 1.

    Raises `UnknownName` for the kind, `UsageError` for a parameter out of range.
    """

    kind: str
    parameter: float

    def __post_init__(self) -> None:
        if self.kind not in SCHEDULES:
            raise UnknownName("beta schedule", self.kind, SCHEDULES)
        if not (self.parameter >= 1 if self.kind == "linear" else 0 <= self.parameter <= 1):
            expected = "at least 1 round" if self.kind == "linear" else "0 to 1"
            raise UsageError(f"beta is '{self}'; expected {expected} after {self.kind}:")

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Read what `str` writes; `UsageError` also for a parameter that is missing or no number."""
        kind, _, parameter = text.partition(":")
        number = _number(parameter)
        if kind not in SCHEDULES and _number(text) is not None:
            raise UsageError(f"beta is {text!r}; expected constant:{text}, linear:ROUNDS or exponential:B")
        if kind in SCHEDULES and number is None:
            raise UsageError(f"beta is {text!r}; expected {kind}:NUMBER ({SCHEDULES[kind]})")
        return cls(kind, number or 0.0)

    def __str__(self) -> str:
        return f"{self.kind}:{self.parameter:g}"

    def __call__(self, round_: int) -> float:
        """Return the probability that the expert drives a step of this round."""
        if round_ == 0:
            return 1.0
        if self.kind == "constant":
            return self.parameter
        if self.kind == "linear":
            return max(0.0, 1.0 - round_ / self.parameter)
        return self.parameter**round_


def _number(text: str) -> float | None:
    try:
        return float(text)
    except ValueError:
        return None


CORRECTION = 0.25  # of the longest step: where expert and learner differ by more, the label corrects


@dataclass(frozen=True)
class Sampling:
    """Relative weight of a frame. All equal: each frame once an epoch.

    demonstrations: of round 0. corrections: of later rounds, where the expert drove, or its label differs from the
    executed action by more than `CORRECTION`. rollouts: the others of later rounds.
    """

    demonstrations: float = option(1.0, "weight of a frame of round 0")
    corrections: float = option(1.0, "weight of a later frame where the expert drove or would have acted differently")
    rollouts: float = option(1.0, "weight of the other later frames")

    def __post_init__(self) -> None:
        for one in fields(self):
            value = getattr(self, one.name)
            if not 0 <= value < math.inf:
                raise UsageError(f"sampling.{one.name} is {value}; expected 0 or more")
        if self.demonstrations == 0:
            raise UsageError("sampling.demonstrations is 0, but round 0 has nothing else to learn from")

    @property
    def is_even(self) -> bool:
        """Whether no kind is preferred."""
        return self.demonstrations == self.corrections == self.rollouts

    def weights(self, table: Mapping[str, NDArray[Any]], scale: F64) -> F64 | None:
        """Return the weight of every frame of a table with `fitting.COLUMNS`, (N,); None where all are equal.

        scale: see `action_gap`.
        """
        if self.is_even:
            return None
        import numpy as np

        from manip_il.collect.query import action_gap
        from manip_il.data.schema import ACTION, ACTOR, EXECUTED_ACTION, ROUND
        from manip_il.mdp import Actor

        gap = action_gap(table[ACTION], table[EXECUTED_ACTION], scale)
        by_expert = table[ACTOR].reshape(-1) != Actor.LEARNER
        later = np.where(by_expert | (gap > CORRECTION), self.corrections, self.rollouts)
        return np.where(table[ROUND].reshape(-1) == 0, self.demonstrations, later).astype(np.float64)


_AT_LEAST_1 = (
    *("demonstrations", "episodes_per_round", "validation_episodes", "ensemble", "patience"),
    *("label_budget", "branch_steps", "refit_steps"),
)
_LEARNER_ALONE = BetaSchedule("constant", 0.0)


@dataclass(frozen=True)
class RunConfig:
    """Options of `manip-il dagger` by their names; round 0 is the expert's own demonstrations unless it is given.

    datasets: recorded demonstrations, in place of those that round 0 would record. start: a `pretrained_model` folder
    that is round 0's policy, in place of cloning; without datasets, round 0 then has no demonstrations. Later rounds
    begin with its weights, and have its architecture.

    method: a name in `ALGORITHMS` (`check_method`). rounds: after round 0, fewer where label_budget, the sound labels
    of all rounds together, is reached before. beta: the share of a round's steps that the expert drives. label,
    branch_steps: what the expert gives in a state in which it is queried, see `RolloutJob`; branch_steps None: as many
    as the policy plans. query_rule: in which states; None: the default of the label mode, see `query`. ensemble:
    policies fitted every round, of which the first drives.

    refit: each round's policy from scratch, or warm from the last one's in refit_steps. validation_episodes: on which
    the best round is chosen; disjoint from the test's by their stream. hold: end a rollout, of validation too, this
    many steps after success. patience: end a rollout in which every state is labelled after this many steps without
    progress: what follows are the same states again. disturbed_share: of a round's learner rollouts that run under
    `manip_il.sim.events.STANDARD`; 0 is the algorithm in an undisturbed world. cameras: what is pictured.
    redraw: policies learn from scenes drawn anew of every round's states, which are then recorded without pictures.
    conditions: what the worlds of all episodes differ in, validation's too.
    """

    env: EnvConfig = field(default_factory=EnvConfig)
    method: str = "dagger"
    demonstrations: int = option(50, "successful expert episodes to begin with (round 0)")
    rounds: int = option(5, "DAgger rounds after round 0; a resumed run may have more", grows=True)
    episodes_per_round: int = option(50, "rollouts per round; with --method=cloning, successful ones")
    label_budget: int | None = option(None, "expert labels of all rounds together at which the run ends")
    beta: BetaSchedule = option(
        lambda: _LEARNER_ALONE, "share of steps that the expert drives: constant:B, linear:ROUNDS, exponential:B"
    )
    label: Literal["per_state", "takeover", "branch"] = option(
        "per_state",
        "what the expert gives when it is queried: one action, a drive to the end, or a branch (docs/dagger.md)",
    )
    query_rule: Query | None = None
    branch_steps: int | None = option(None, "control steps of a branch; by default as many as the policy plans")
    ensemble: int = option(1, "policies fitted a round, of which the first drives; for --query=ensemble:BOUND")
    sampling: Sampling = field(default_factory=Sampling)
    refit: Literal["scratch", "warm"] = option("scratch", "how each round's policy starts")
    refit_steps: int | None = option(None, "gradient steps in later rounds, with --refit=warm; by default as many")
    fit: FitConfig = field(default_factory=FitConfig)
    validation_episodes: int = option(200, "unseen episodes that choose the best round")
    hold: int = option(10, "control steps of a rollout after success")
    patience: int = option(100, "control steps without progress after which a rollout with a label a state ends")
    disturbed_share: float = option(
        0.5, "share of a round's rollouts that are disturbed: object knocked, noisy actions"
    )
    cameras: CameraConfig | None = None
    redraw: int = option(
        0, "scenes drawn anew from round 0's states for a policy on pictures, and as many a state in later rounds"
    )
    conditions: tuple[Condition, ...] = ()
    seed: int = option(0, "shifts every random stream, 0 to 1000", at_least=0, at_most=1000)
    datasets: tuple[Path, ...] = ()
    start: Path | None = None

    def __post_init__(self) -> None:
        from manip_il.seeding import MAX_ROUNDS

        for name in _AT_LEAST_1:
            if (value := getattr(self, name)) is not None and value < 1:
                raise UsageError(f"{name} is {value}; expected at least 1")
        if not 0 <= self.disturbed_share <= 1:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; expected 0 to 1")
        if self.disturbed_share and self.env.robot == STOCK:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; {STOCK} is unmodified, expected 0")
        if self.rounds < 0:
            raise UsageError(f"rounds is {self.rounds}; expected at least 0")
        if self.rounds >= MAX_ROUNDS:
            raise UsageError(f"rounds is {self.rounds}; expected fewer than {MAX_ROUNDS}")
        if self.redraw < 0:
            raise UsageError(f"redraw is {self.redraw}; expected the number of scenes")
        if self.redraw and (self.cameras is None or self.label != "per_state" or not self.sampling.is_even):
            raise UsageError("redraw is for policies on pictures, with --label=per_state and even sampling")
        if self.refit_steps is not None and self.refit == "scratch":
            raise UsageError("refit_steps is for refit=warm; a policy from scratch takes all steps")
        self._check_queries()

    def _check_queries(self) -> None:
        rule, kind = self.query_rule, self.query_rule.kind if self.query_rule else "every"
        if self.label == "takeover" and self.beta != _LEARNER_ALONE:
            raise UsageError(f"label is 'takeover', so the learner rolls in alone; beta is '{self.beta}', leave it out")
        if self.label == "takeover" and rule is not None and kind == "every":
            raise UsageError("label is 'takeover' and query 'every': the expert would drive from the first step on")
        if kind == "ensemble" and self.ensemble < 2:
            raise UsageError(f"query is '{rule}', but there is one policy; give ensemble=2 or more")
        if self.start is not None and self.ensemble > 1:
            raise UsageError(
                f"ensemble is {self.ensemble}, but --policy.path is one policy to begin with; leave it out"
            )
        if kind != "ensemble" and self.ensemble > 1:
            raise UsageError(f"ensemble is {self.ensemble}, but no query uses it; give query=ensemble:BOUND too")

    @property
    def has_queries(self) -> bool:
        """Whether label, query or beta is not the default: they are for rounds in which the learner drives."""
        return (self.label, self.query_rule, self.beta) != ("per_state", None, _LEARNER_ALONE)

    def episodes(self, round_: int) -> int:
        """Return episodes of a round."""
        return self.demonstrations if round_ == 0 else self.episodes_per_round

    @property
    def steps_of_branch(self) -> int:
        """Return the control steps of a branch: those given, else enough to learn a whole plan from."""
        return self.branch_steps or sum(plan_of(self.fit))

    @property
    def query(self) -> Query:
        """The rule by which the expert is queried, by default one of the label mode.

        `per_state`: everywhere; `takeover`: once; `branch`: for as many labels as steps.
        """
        from manip_il.collect.query import Query

        if self.query_rule is not None or self.label == "per_state":
            return self.query_rule or Query()
        return Query("one") if self.label == "takeover" else Query("probability", 1 / self.steps_of_branch)


def plan_of(fit: FitConfig) -> tuple[int, int]:
    """Return how many actions a policy plans at once, and how many last frames of an episode it does not learn from."""
    if fit.is_mlp:  # without LeRobot, whose import takes seconds
        return 1, 0
    from manip_il.learn.lerobot_config import policy_config

    policy = policy_config(fit)
    return len(policy.action_delta_indices or [0]), getattr(policy, "drop_n_last_frames", 0)


def check_cameras(config: RunConfig) -> None:
    """Raise `UsageError` unless pictures are rendered exactly where the policy takes some."""
    takes_images = config.fit.takes_images
    if takes_images and config.cameras is None:
        raise UsageError("the policy takes images, but none are rendered; give --cameras=front,side,wrist")
    if config.cameras is not None and not takes_images:
        raise UsageError("images are rendered, but the policy takes none; leave out --cameras or --observation=images")


def check_labels(config: RunConfig) -> None:
    """Raise `UsageError` for labels that the policy cannot learn from, or a query rule that it cannot answer.

    LeRobot's configurations are made for this, which imports it; they raise what is wrong with them, too.
    """
    from manip_il.learn.lerobot_config import LeRobotFit

    fit = config.fit
    LeRobotFit(fit)
    plan, dropped = plan_of(fit)
    name, rule = fit.policy.get("type", "mlp"), config.query
    if config.label == "per_state" and plan > 1 and rule.kind != "every":
        raise UsageError(
            f"query={rule} with label=per_state yields single labels, and {name} learns from {plan} in a row; "
            "use label=branch or label=takeover"
        )
    if config.label == "branch" and config.steps_of_branch <= dropped:
        raise UsageError(
            f"branch_steps is {config.steps_of_branch}, but {name} leaves out the last {dropped} frames of "
            "every episode; give more, or --policy.drop_n_last_frames=0"
        )
    if rule.kind == "likelihood":
        from manip_il.learn.losses import LIKELIHOODS
        from manip_il.learn.policy import NO_LIKELIHOOD

        if not fit.is_mlp or fit.policy.get("loss", MLPOptions.loss) not in LIKELIHOODS:
            raise UsageError(NO_LIKELIHOOD)
