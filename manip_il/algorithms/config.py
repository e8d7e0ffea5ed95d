"""Options of one run of an imitation algorithm, and checks that they are consistent."""

from __future__ import annotations

import contextlib
import math
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il.errors import UnknownName, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.option import Seeded, check_bounds, option
from manip_il.sim.config import CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec, make_config

if TYPE_CHECKING:  # so that `manip-il dagger --help` does not import numpy
    from manip_il.collect.query import Query
    from manip_il.sim.conditions import Condition


_BOUNDS = {"constant": (0, 1), "linear": (1, math.inf), "exponential": (0, 1)}


@dataclass(frozen=True)
class BetaSchedule:
    """A schedule `kind:parameter` of beta, the share of steps that the expert drives.

    In round 0 beta is 1.

    `constant:0` lets the learner drive alone from round 1 on (the paper's parameter-free choice),
    `linear:5` falls linearly from 1 in round 0 to 0 in round 5, `exponential:0.5` is 0.5 to the
    power of the round.
    """

    kind: str
    parameter: float

    @classmethod
    def parse(cls, text: str) -> BetaSchedule:
        """Parse `kind:parameter`, as written by `str`.

        Raises:
            UsageError: The text is anything else.
        """
        kind, _, parameter = text.partition(":")
        lowest, highest = _BOUNDS.get(kind, (math.inf, -math.inf))
        with contextlib.suppress(ValueError):
            if lowest <= (number := float(parameter)) <= highest:
                return cls(kind, number)
        raise UsageError(
            f"beta is {text!r}; expected constant:B, linear:ROUNDS or exponential:B, with B from 0"
            " to 1 and at least 1 round"
        )

    def __str__(self) -> str:
        return f"{self.kind}:{self.parameter:g}"

    def __call__(self, round_: int) -> float:
        """Return the probability that the expert drives a step in this round."""
        if round_ == 0:
            return 1.0
        if self.kind == "constant":
            return self.parameter
        if self.kind == "linear":
            return max(0.0, 1.0 - round_ / self.parameter)
        return self.parameter**round_


# each key names a module and its function
ALGORITHMS = {"dagger": "DAgger", "cloning": "Cloning", "dart": "DART"}
# only the expert drives, so label, query and beta have no effect
EXPERT_DRIVES = ("cloning", "dart")

if TYPE_CHECKING:
    Method = str
else:
    Method = Literal[*ALGORITHMS]  # the choices of `--method`

_LEARNER_ALONE = BetaSchedule("constant", 0.0)
_DEFAULTS = ("per_state", None, _LEARNER_ALONE)  # label, query, beta


@dataclass(frozen=True)
class RunConfig(Seeded):
    """Options of `manip-il dagger`.

    Round 0 records the expert's demonstrations unless `datasets` has some. Later rounds start from
    the weights of the policy `start`, if it is given, and keep its architecture.

    Attributes:
        query_rule: When the expert is queried; None for the label mode's default, see `query`.
        hold: Also applies to validation.
        patience: Ends rollouts that only repeat their states.
        disturbed_share: The disturbances are `manip_il.sim.events.STANDARD`.
        cameras: Rendered during rollouts or, with `redraw`, only in the redrawn scenes.
        conditions: Variations of the world in rollouts and validation.
        datasets: Recorded demonstrations that replace those of round 0.
        start: The `pretrained_model` folder of a policy that replaces cloning in round 0; without
            datasets, round 0 then has no demonstrations.
    """

    env: EnvConfig = field(default_factory=make_config)
    method: str = "dagger"
    demonstrations: int = option(50, "successful expert episodes of round 0", at_least=1)
    rounds: int = option(
        5,
        "DAgger rounds after round 0; may be raised when a run is resumed",
        at_least=0,
        at_most=99,
        grows=True,
    )
    episodes_per_round: int = option(
        50, "rollouts per round, or demonstrations with --method=cloning", at_least=1
    )
    label_budget: int | None = option(
        None, "total number of expert labels at which the run ends", at_least=1
    )
    beta: BetaSchedule = option(
        lambda: _LEARNER_ALONE,
        "share of steps that the expert drives: constant:B, linear:ROUNDS, exponential:B",
    )
    label: Literal["per_state", "takeover", "branch"] = option(
        "per_state",
        "what the expert gives if queried: one action, a drive to the end, or a branch"
        " (docs/dagger.md)",
    )
    query_rule: Query | None = None
    branch_steps: int | None = option(
        None,
        "control steps of a branch; by default just enough for one whole action chunk",
        at_least=1,
    )
    ensemble: int = option(
        1, "policies fitted per round, for --query=ensemble:BOUND; the first one drives", at_least=1
    )
    refit: Literal["scratch", "warm"] = option(
        "scratch", "each round's initial weights: random or the last round's"
    )
    refit_steps: int | None = option(
        None,
        "gradient steps in later rounds, with --refit=warm; by default as many as in round 0",
        at_least=1,
    )
    fit: FitConfig = field(default_factory=FitConfig)
    validation_episodes: int = option(
        200, "unseen episodes by which the best round is chosen", at_least=1
    )
    hold: int = option(10, "control steps of a rollout after success", at_least=0)
    patience: int = option(
        100,
        "control steps without progress after which a rollout ends, if every state gets a label",
        at_least=1,
    )
    disturbed_share: float = option(
        None,
        "share of a round's rollouts with disturbances: knocked object, noisy actions; by default"
        " half of them, and none if the environment cannot be varied",
        at_least=0,
        at_most=1,
    )
    cameras: CameraConfig | None = None
    redraw: int = option(
        0,
        "number of scenes redrawn from round 0's states, for picture policies; later rounds get as"
        " many per state",
        at_least=0,
    )
    conditions: tuple[Condition, ...] = ()
    datasets: tuple[Path, ...] = ()
    start: Path | None = None

    def __post_init__(self) -> None:
        spec = env_spec(self.env)
        if self.disturbed_share is None:
            object.__setattr__(self, "disturbed_share", 0.5 if "varied" in spec.can else 0.0)
        check_bounds(self)
        if self.disturbed_share:
            spec.require("varied", "give --disturbed_share=0")
        if self.redraw and (self.cameras is None or self.label != "per_state"):
            raise UsageError("redraw is for picture policies; give --cameras and --label=per_state")
        if self.method not in ALGORITHMS:
            raise UnknownName("method", self.method, ALGORITHMS)
        if self.method in EXPERT_DRIVES and (self.label, self.query_rule, self.beta) != _DEFAULTS:
            raise UsageError(
                f"only the expert drives in {self.method!r}; leave out label, query and beta"
            )
        if self.fit.takes_images != (self.cameras is not None):
            seen = ",".join(self.cameras.names) if self.cameras else "none"
            raise UsageError(
                f"--observation={self.fit.observes} with --cameras={seen}; expected cameras, such"
                " as front,side,wrist, if the policy takes images, and only then"
            )
        if self.method == "dart" and self.cameras is not None:
            raise UsageError(
                "method 'dart' measures the learner's errors on state vectors; it does not support"
                " images"
            )
        self._check_queries()

    def _check_queries(self) -> None:
        rule = self.query_rule
        if self.label == "takeover" and self.beta != _LEARNER_ALONE:
            raise UsageError(
                f"beta is '{self.beta}', but label 'takeover' starts with the learner alone; omit"
                " beta"
            )
        if self.start is not None and self.ensemble > 1:
            raise UsageError(
                f"ensemble is {self.ensemble}, but --policy.path gives one policy; expected 1"
            )
        if (rule is not None and rule.kind == "ensemble") != (self.ensemble > 1):
            raise UsageError(
                f"ensemble is {self.ensemble} with query={rule or 'every'}; expected 2 or more with"
                " query=ensemble:BOUND, else 1"
            )

    @property
    def steps_of_branch(self) -> int:
        """Control steps that the expert drives in a branch.

        By default just enough for one whole action chunk.
        """
        return self.branch_steps or sum(plan_of(self.fit))

    @property
    def query(self) -> Query:
        """The rule that decides when the expert is queried.

        By default it depends on the label mode.

        `per_state`: in every state; `takeover`: once; `branch`: at random, for about one label per
        step.
        """
        from manip_il.collect.query import Query

        if self.query_rule is not None or self.label == "per_state":
            return self.query_rule or Query()
        return (
            Query("one")
            if self.label == "takeover"
            else Query("probability", 1 / self.steps_of_branch)
        )


def plan_of(fit: FitConfig) -> tuple[int, int]:
    """Return how many actions a policy plans at once, and how many frames at an episode's end its
    fit skips.

    It imports LeRobot, which constructs its configurations, and raises what `lerobot_options`
    raises.
    """
    from manip_il.learn.lerobot_config import lerobot_options

    policy: Any = lerobot_options(fit)[0].policy
    return len(policy.action_delta_indices or [0]), getattr(policy, "drop_n_last_frames", 0)


def check_labels(config: RunConfig) -> None:
    """Raise `UsageError` for labels that the policy cannot learn from, or for invalid LeRobot
    options.
    """
    plan, dropped = plan_of(config.fit)
    name, rule = config.fit.kind, config.query
    if config.label == "per_state" and plan > 1 and rule.kind != "every":
        raise UsageError(
            f"query={rule} with label=per_state gives single labels, but {name} learns from {plan}"
            " in a row; use label=branch or label=takeover"
        )
    if config.label == "branch" and config.steps_of_branch <= dropped:
        raise UsageError(
            f"branch_steps is {config.steps_of_branch}, but {name} ignores the last {dropped}"
            " frames of every episode; give more, or --policy.drop_n_last_frames=0"
        )
