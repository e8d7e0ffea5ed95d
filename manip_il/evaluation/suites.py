"""Suites of conditions for evaluations, and the parts of a condition that affect a task."""

from collections.abc import Sequence
from pathlib import Path

from manip_il import checks
from manip_il.errors import UnknownName, UsageError
from manip_il.sim.conditions import Condition, merged
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.table import env_spec, world_of

SUITES = {
    "nominal": ("nominal",),
    "disturbed": ("knocked", "sensing", "late"),
    "randomised": ("object", "view", "clutter", "dynamics"),
    "all": ("nominal", "knocked", "sensing", "late", "object", "view", "clutter", "dynamics"),
}
CONDITIONS = (*SUITES["all"], "random_actions", "servo")
_YAML = (".yaml", ".yml")
_OWN = Path(__file__).with_name("conditions")  # the YAML files of `CONDITIONS`


def suite_conditions(suite: str, env: EnvConfig, *, sees: bool) -> tuple[Condition, ...]:
    """Return the conditions of a suite, in the order in which seeds cycle through them.

    Conditions without effect are omitted: those on objects if the task has none, and those on
    cameras if the policy uses none. Objects' sizes are limited to those that the task allows.

    Args:
        suite: A name in `SUITES` or `CONDITIONS`, or the path of a YAML file of ranges.
        env: The environment of the evaluation.
        sees: Whether the policy uses cameras.

    Raises:
        UnknownName: for an unknown suite.
        UsageError: if the file is invalid, or if no condition is left.
    """
    asked = [read_condition(name) for name in SUITES.get(suite, (suite,))]
    world = world_of(env.robot, env.task)
    affecting = (world.affecting(env, condition, sees=sees) for condition in asked)
    left = tuple(condition for condition in affecting if condition is not None)
    if not left:
        blind = "" if sees else " and a policy without cameras"
        raise UsageError(
            f"--suite={suite} changes nothing for {env.task}{blind}; choose another suite"
        )
    return left


def varied(names: Sequence[str], env: EnvConfig, *, sees: bool) -> tuple[Condition, ...]:
    """Merge the conditions in `--vary` into one, from which every episode samples.

    Args:
        names: Names in `CONDITIONS` other than nominal, or paths of YAML files of ranges.
        env: The environment.
        sees: Whether cameras are used.

    Returns:
        The merged condition alone; () if there are no names.

    Raises:
        UnknownName: for an unknown name.
        UsageError: if a file is invalid, if nothing has an effect, or the environment cannot vary.
    """
    if not names:
        return ()
    if odd := next(
        (name for name in names if name not in CONDITIONS[1:] and not name.endswith(_YAML)), None
    ):
        raise UnknownName("--vary", odd, CONDITIONS[1:])
    asked = merged([read_condition(name) for name in names])
    kept = world_of(env.robot, env.task).affecting(env, asked, sees=sees)
    if kept is None:
        env_spec(env).require("varied", "leave out --vary")
        raise UsageError(
            f"--vary={','.join(names)} changes nothing for"
            f" {env.task}{'' if sees else ' without cameras'}"
        )
    return (kept,)


def read_condition(name: str) -> Condition:
    """Return a condition, given its name or the path of a YAML file of ranges.

    Raises `UnknownName` for an unknown name, `UsageError` for a file that is missing or invalid.
    """
    if not name.endswith(_YAML) and name not in CONDITIONS:
        raise UnknownName("suite", name, [*SUITES, *CONDITIONS[1:]])
    path = Path(name) if name.endswith(_YAML) else _OWN / f"{name}.yaml"
    tree = checks.read_yaml(path, "a YAML file of ranges")
    if not isinstance(tree, dict | None):
        raise UsageError(
            f"{path} holds {type(tree).__name__}; expected a mapping of names to ranges"
        )
    return Condition(path.stem, **{str(key): value for key, value in (tree or {}).items()})
