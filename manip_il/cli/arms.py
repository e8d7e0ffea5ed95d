"""An arm of a study: `manip-il dagger`, or an algorithm that begins with what round 0 of such an arm made."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il import checks
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.learning import AirlOptions, GailOptions, GivenGroup, PpoOptions
from manip_il.cli.parsing import from_layers
from manip_il.errors import MismatchError, UnknownName, UsageError

if TYPE_CHECKING:
    from manip_il.evaluation.rounds import History
    from manip_il.sim.config import EnvConfig

ROUND_0 = "round_000"
ALGORITHM = "algorithm"  # the key of an arm that names one of these
LearningOptions = GailOptions | PpoOptions  # an AirlOptions is a GailOptions
ArmOptions = DaggerOptions | LearningOptions
ALGORITHMS: Mapping[str, type[LearningOptions]] = {"gail": GailOptions, "airl": AirlOptions, "ppo": PpoOptions}


def read_arm(common: tuple[str, Mapping[str, Any]], own: tuple[str, Mapping[str, Any]]) -> ArmOptions:
    """Return an arm's options; each argument is an origin, for errors, and a tree. common: of `manip-il dagger` alone.

    Raises `UsageError` for an option that is none, `UnknownName` for an algorithm.
    """
    origin, tree = own
    if ALGORITHM not in tree:
        return from_layers(DaggerOptions, [common, own])
    name = tree[ALGORITHM]
    if not isinstance(name, str) or name not in ALGORITHMS:
        raise UnknownName("algorithm", str(name)[: checks.LONGEST_NAME], ALGORITHMS)
    return from_layers(ALGORITHMS[name], [(origin, {key: tree[key] for key in tree if key != ALGORITHM})])


def first_arm(options: ArmOptions, arms: Mapping[str, ArmOptions]) -> str | None:
    """Return the arm that a learning one begins with; None for one of `manip-il dagger`.

    `dataset.root` and `init` name it in place of a path. arms: those before it. Raises `UsageError` for another.
    """
    if isinstance(options, DaggerOptions):
        return None
    roots = options.dataset.root if isinstance(options, GailOptions) else []
    named = [str(path) for path in (*roots, options.init) if path is not None]
    known = [name for name, other in arms.items() if isinstance(other, DaggerOptions)]
    if len(set(named)) != 1 or named[0] not in known:
        raise UsageError(
            f"dataset.root and init are {', '.join(named) or 'not given'}; expected the name of one arm of manip-il "
            f"dagger before it, whose demonstrations and policy it begins with: {', '.join(known) or 'there is none'}"
        )
    return named[0]


def learning_env(arm: str, env: EnvConfig) -> EnvConfig:
    """Return the environment of a run that begins with an arm's; raises `MismatchError` for one with other settings.

    A dataset and a checkpoint tell robot, task and rate, nothing else.
    """
    known = type(env)(env.robot, env.task, env.control_hz, object=env.object)
    if env != known:
        raise MismatchError("environment", f"arm {arm!r}", env, "a run that begins with it", known)
    return env


def with_start_policy(options: ArmOptions, folder_of: Callable[[str], Path]) -> ArmOptions:
    """Return a learning arm's options with the demonstrations and policy of the run in place of its arm's name."""
    if isinstance(options, DaggerOptions):
        return options
    if options.init is not None:
        options = replace(options, init=folder_of(str(options.init)) / ROUND_0 / "policy")
    if isinstance(options, GailOptions):
        roots = [folder_of(str(root)) / ROUND_0 / "dataset" for root in options.dataset.root]
        options = replace(options, dataset=GivenGroup(roots))
    return options


def with_start_cost(options: ArmOptions, own: History, run: Path) -> History:
    """Return a learning arm's rounds with the costs of what it begins with: round 0 in `run`, its fit with `init`."""
    from manip_il.evaluation.rounds import history, read_metrics

    if isinstance(options, DaggerOptions):
        return own
    records = read_metrics(run)
    start = history(records, str(run))[0]
    fitted = start.seconds if options.init is not None else float(records[0]["seconds"]["collect"])
    return tuple(one.after(start, fitted=fitted) for one in own)
