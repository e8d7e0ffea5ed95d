"""Options of one run of an algorithm: the driver, the data, and all of it checked against each other."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manip_il.errors import UnknownName, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.option import Seeded, check_bounds, option
from manip_il.sim.config import CameraConfig
from manip_il.tasks.config import EnvConfig, make_config
from manip_il.tasks.stock.table import ROBOTS as STOCK

if TYPE_CHECKING:  # help of `manip-il dagger` reads the options, without numpy
    from manip_il.collect.query import Query
    from manip_il.sim.conditions import Condition


@dataclass(frozen=True)
class BetaSchedule:
    """`kind:parameter`. Round 0 is the expert's own: beta is 1.

    `constant:0` lets the learner drive alone from round 1 on (the paper's parameter-free choice), `linear:5` falls
    evenly from 1 in round 0 to 0 in round 5, `exponential:0.5` is 0.5 to the power of the round.
    """

    kind: str
    parameter: float

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Read what `str` writes. Raises `UsageError` for anything else."""
        kind, _, parameter = text.partition(":")
        try:
            number = float(parameter)
        except ValueError:
            number = math.nan
        if not ((kind == "linear" and number >= 1) or (kind in ("constant", "exponential") and 0 <= number <= 1)):
            kinds = "constant:B, linear:ROUNDS or exponential:B, with B from 0 to 1 and at least 1 round"
            raise UsageError(f"beta is {text!r}; expected {kinds}")
        return cls(kind, number)

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


ALGORITHMS = {"dagger": "DAgger", "cloning": "Cloning", "dart": "DART"}  # each the function and module of its name
EXPERT_DRIVES = ("cloning", "dart")  # throughout, so that label, query and beta mean nothing

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[*ALGORITHMS]  # the choices of `--method`

_LEARNER_ALONE = BetaSchedule("constant", 0.0)
_DEFAULTS = ("per_state", None, _LEARNER_ALONE)  # of label, query and beta


@dataclass(frozen=True)
class RunConfig(Seeded):
    """Options of `manip-il dagger` by their names; round 0 is the expert's own demonstrations unless it is given.

    datasets: recorded demonstrations, in place of those that round 0 would record. start: a `pretrained_model` folder
    that is round 0's policy, in place of cloning; without datasets, round 0 then has no demonstrations. Later rounds
    begin with its weights, and have its architecture.

    query_rule: None is the default of the label mode, see `query`. hold: of validation's rollouts, too. patience: what
    follows are the same states again. disturbed_share: under `manip_il.sim.events.STANDARD`. cameras: what is pictured;
    with redraw, no pictures are recorded. conditions: what the worlds of all episodes differ in, validation's too.
    """

    env: EnvConfig = field(default_factory=make_config)
    method: str = "dagger"
    demonstrations: int = option(50, "successful expert episodes to begin with (round 0)", at_least=1)
    rounds: int = option(
        5, "DAgger rounds after round 0; a resumed run may have more", at_least=0, at_most=99, grows=True
    )
    episodes_per_round: int = option(50, "rollouts per round; with --method=cloning, successful ones", at_least=1)
    label_budget: int | None = option(None, "expert labels of all rounds together at which the run ends", at_least=1)
    beta: BetaSchedule = option(
        lambda: _LEARNER_ALONE, "share of steps that the expert drives: constant:B, linear:ROUNDS, exponential:B"
    )
    label: Literal["per_state", "takeover", "branch"] = option(
        "per_state",
        "what the expert gives when it is queried: one action, a drive to the end, or a branch (docs/dagger.md)",
    )
    query_rule: Query | None = None
    branch_steps: int | None = option(
        None, "control steps of a branch; by default as many as the policy plans", at_least=1
    )
    ensemble: int = option(
        1, "policies fitted a round, of which the first drives; for --query=ensemble:BOUND", at_least=1
    )
    refit: Literal["scratch", "warm"] = option("scratch", "how each round's policy starts")
    refit_steps: int | None = option(
        None, "gradient steps in later rounds, with --refit=warm; by default as many", at_least=1
    )
    fit: FitConfig = field(default_factory=FitConfig)
    validation_episodes: int = option(200, "unseen episodes that choose the best round", at_least=1)
    hold: int = option(10, "control steps of a rollout after success")
    patience: int = option(
        100, "control steps without progress after which a rollout with a label a state ends", at_least=1
    )
    disturbed_share: float = option(
        0.5, "share of a round's rollouts that are disturbed: object knocked, noisy actions", at_least=0, at_most=1
    )
    cameras: CameraConfig | None = None
    redraw: int = option(
        0,
        "scenes drawn anew from round 0's states for a policy on pictures, and as many a state in later rounds",
        at_least=0,
    )
    conditions: tuple[Condition, ...] = ()
    datasets: tuple[Path, ...] = ()
    start: Path | None = None

    def __post_init__(self) -> None:
        check_bounds(self)
        if self.disturbed_share and self.env.robot in STOCK:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; {self.env.robot} is unmodified, expected 0")
        if self.redraw and (self.cameras is None or self.label != "per_state"):
            raise UsageError("redraw is for policies on pictures, with --label=per_state")
        if self.method not in ALGORITHMS:
            raise UnknownName("method", self.method, ALGORITHMS)
        if self.method in EXPERT_DRIVES and (self.label, self.query_rule, self.beta) != _DEFAULTS:
            raise UsageError(f"method {self.method!r} has the expert drive throughout; leave out label, query and beta")
        if self.fit.takes_images and self.cameras is None:
            raise UsageError("the policy takes images, but none are rendered; give --cameras=front,side,wrist")
        if self.cameras is not None and not self.fit.takes_images:
            raise UsageError("images are rendered, but the policy takes none; leave out --cameras or --observation")
        if self.method == "dart" and self.cameras is not None:
            raise UsageError("method 'dart' measures the learner's errors from state vectors; it is not for images")
        self._check_queries()

    def _check_queries(self) -> None:
        rule = self.query_rule
        if self.label == "takeover" and self.beta != _LEARNER_ALONE:
            raise UsageError(f"label is 'takeover', so the learner rolls in alone; beta is '{self.beta}', leave it out")
        if self.start is not None and self.ensemble > 1:
            raise UsageError(f"ensemble is {self.ensemble}, but --policy.path is one policy to begin with")
        if (rule is not None and rule.kind == "ensemble") != (self.ensemble > 1):
            raise UsageError(f"ensemble is {self.ensemble}, query '{rule or 'every'}'; ensemble:BOUND takes 2 or more")

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


def check_labels(config: RunConfig) -> None:
    """Raise `UsageError` for labels that the policy cannot learn from.

    LeRobot's configurations are made for this, which imports it; they raise what is wrong with them, too.
    """
    from manip_il.learn.lerobot_config import lerobot_options

    fit = config.fit
    lerobot_options(fit)
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
