"""Options of one run of an algorithm: the driver, the data, and all of it checked against each other."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from manip_il.errors import UnknownName, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.option import check_bounds, option
from manip_il.sim.config import CameraConfig
from manip_il.tasks.config import EnvConfig, make_config
from manip_il.tasks.stock.table import ROBOT as STOCK

if TYPE_CHECKING:  # help of `manip-il dagger` reads the options, without numpy
    from manip_il.collect.query import Query
    from manip_il.sim.conditions import Condition

_KINDS = "constant:B, linear:ROUNDS or exponential:B, with B from 0 to 1 and at least 1 round"


@dataclass(frozen=True)
class BetaSchedule:
    """`kind:parameter`. Round 0 is the expert's own: beta is 1.

    `constant:0` lets the learner drive alone from round 1 on (the paper's parameter-free choice), `linear:5` falls
    evenly from 1 in round 0 to 0 in round 5, `exponential:0.5` is 0.5 to the power of the round. Raises `UsageError`
    for anything else.
    """

    kind: str
    parameter: float

    def __post_init__(self) -> None:
        allowed = {"constant": 0 <= self.parameter <= 1, "linear": self.parameter >= 1}
        if not (allowed | {"exponential": 0 <= self.parameter <= 1}).get(self.kind):
            raise UsageError(f"beta is '{self}'; expected {_KINDS}")

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Read what `str` writes."""
        kind, _, parameter = text.partition(":")
        try:
            return cls(kind, float(parameter))
        except ValueError as error:
            raise UsageError(f"beta is {text!r}; expected {_KINDS}") from error

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


@dataclass(frozen=True)
class Algorithm:
    """One way to learn: the function of its name, in the module of its name. title: in reports. driver: for the help.

    learner_drives: whether it does in some rounds, so that label, query and beta mean something. takes_images: whether
    policies may look at pictures.
    """

    title: str
    driver: str
    learner_drives: bool = True
    takes_images: bool = True


ALGORITHMS = {
    "dagger": Algorithm("DAgger", "the learner"),
    "cloning": Algorithm("Cloning", "the expert", learner_drives=False),
    "dart": Algorithm("DART", "the expert with noise like the learner's errors", False, takes_images=False),
}

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[*ALGORITHMS]  # the choices of `--method`


@dataclass(frozen=True)
class Sampling:
    """Relative weight of a frame. All equal: each frame once an epoch.

    demonstrations: of round 0. corrections: of later rounds, where the expert drove, or its label differs from the
    executed action by more than a quarter of the longest step. rollouts: the others of later rounds.
    """

    demonstrations: float = option(1.0, "weight of a frame of round 0", at_least=0)
    corrections: float = option(
        1.0, "weight of a later frame where the expert drove or would have acted differently", at_least=0
    )
    rollouts: float = option(1.0, "weight of the other later frames", at_least=0)

    def __post_init__(self) -> None:
        check_bounds(self, "sampling.")
        if self.demonstrations == 0:
            raise UsageError("sampling.demonstrations is 0, but round 0 has nothing else to learn from")

    @property
    def is_even(self) -> bool:
        """Whether no kind is preferred."""
        return self.demonstrations == self.corrections == self.rollouts


_LEARNER_ALONE = BetaSchedule("constant", 0.0)


@dataclass(frozen=True)
class RunConfig:
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
    rounds: int = option(5, "DAgger rounds after round 0; a resumed run may have more", grows=True)
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
    sampling: Sampling = field(default_factory=Sampling)
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
    seed: int = option(0, "shifts every random stream, 0 to 1000", at_least=0, at_most=1000)
    datasets: tuple[Path, ...] = ()
    start: Path | None = None

    def __post_init__(self) -> None:
        from manip_il.seeding import MAX_ROUNDS

        check_bounds(self)
        if self.disturbed_share and self.env.robot == STOCK:
            raise UsageError(f"disturbed_share is {self.disturbed_share}; {STOCK} is unmodified, expected 0")
        if not 0 <= self.rounds < MAX_ROUNDS:
            raise UsageError(f"rounds is {self.rounds}; expected 0 or more, fewer than {MAX_ROUNDS}")
        if self.redraw and (self.cameras is None or self.label != "per_state" or not self.sampling.is_even):
            raise UsageError("redraw is for policies on pictures, with --label=per_state and even sampling")
        if self.refit_steps is not None and self.refit == "scratch":
            raise UsageError("refit_steps is for refit=warm; a policy from scratch takes all steps")
        self._check_method()
        self._check_queries()

    def _check_method(self) -> None:
        """Options are for the method, and pictures are rendered exactly if the policy takes some."""
        if self.method not in ALGORITHMS:
            raise UnknownName("method", self.method, ALGORITHMS)
        algorithm, queries = ALGORITHMS[self.method], (self.label, self.query_rule, self.beta)
        if not algorithm.learner_drives and queries != ("per_state", None, _LEARNER_ALONE):
            raise UsageError(f"method {self.method!r} has the expert drive throughout; leave out label, query and beta")
        if not self.fit.takes_images:
            if self.cameras is not None:
                raise UsageError("images are rendered, but the policy takes none; leave out --cameras or --observation")
            return
        if not algorithm.takes_images:
            raise UsageError(
                f"method {self.method!r} measures the learner's errors from state vectors; it is not for a policy on "
                "images"
            )
        if self.cameras is None:
            raise UsageError("the policy takes images, but none are rendered; give --cameras=front,side,wrist")

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


def check_labels(config: RunConfig) -> None:
    """Raise `UsageError` for labels that the policy cannot learn from, or a query rule that it cannot answer.

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
    if rule.kind == "likelihood":
        from manip_il.learn.losses import LIKELIHOODS
        from manip_il.learn.policy import NO_LIKELIHOOD

        if not fit.is_mlp or fit.policy.get("loss") not in LIKELIHOODS:
            raise UsageError(NO_LIKELIHOOD)
