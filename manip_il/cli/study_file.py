"""The file of a study: what its arms share, how they differ, and how they are compared.

An arm is `manip-il dagger`, or an algorithm that begins with what round 0 of such an arm made.
"""

from __future__ import annotations

from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from manip_il import checks
from manip_il.cli.common_options import TrialGroup
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.learning import AirlOptions, GailOptions, GivenGroup, PpoOptions
from manip_il.cli.options import Open, to_plain
from manip_il.cli.parsing import check_values, dump_yaml, from_layers, from_yaml
from manip_il.data.atomic import write_file
from manip_il.data.json_lines import read_lines
from manip_il.errors import ManipError, MismatchError, UnknownName, UsageError
from manip_il.option import option
from manip_il.seeding import MAX_SEED

if TYPE_CHECKING:
    from manip_il.evaluation.rounds import History, Rule
    from manip_il.tasks.config import EnvConfig

STUDY_FILE = "study.yaml"
ROUND_0 = "round_000"
ALGORITHM = "algorithm"  # the key of an arm that names one of these
LearningOptions = GailOptions | PpoOptions  # an AirlOptions is a GailOptions
ArmOptions = DaggerOptions | LearningOptions
ALGORITHMS: Mapping[str, type[LearningOptions]] = {"gail": GailOptions, "airl": AirlOptions, "ppo": PpoOptions}
OWN = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")  # options of a run that the study itself sets


@dataclass
class ExpertTest:
    """One test of the expert in every arm's task, by default on the arm's robot.

    suite: as of `manip-il eval`. vary: as of `manip-il dagger`.
    """

    robot: str | None = None
    suite: str = "nominal"
    vary: list[str] = field(default_factory=list[str])
    n_episodes: int = option(500, "test episodes", at_least=1)


@dataclass
class StudyFile:
    """Content of a study's YAML file.

    common: options of `manip-il dagger` that all its arms share. arms: name -> options in which an arm differs; with
    `algorithm: gail`, `airl` or `ppo` those of that command, where `dataset.root` and `init` name another arm. Where
    the task differs, nothing is compared, and expert (name -> `ExpertTest`) adds what the expert solves of each. suite:
    as `manip-il eval --suite=`, for the test. within: amounts as of `at`, such as steps:20000.
    """

    common: Open = field(default_factory=dict[str, Any])
    arms: Open = field(default_factory=dict[str, Any])
    expert: Open = field(default_factory=dict[str, Any])
    training_seeds: int = option(3, "runs of every arm", at_least=1, at_most=MAX_SEED)
    eval: TrialGroup = field(default_factory=TrialGroup)
    suite: str = "nominal"
    checkpoint: Literal["best", "last"] = "best"
    at: str = "end"
    baseline: str | None = option(None, "the arm that others are compared with; by default the first")
    target: float = option(0.95, "validation success whose cost is reported", at_least=0.0, at_most=1.0)
    within: list[str] = option(list, "costs up to which the best validation success is reported")


@dataclass(frozen=True)
class Plan:
    """A checked file: the options of every arm are valid.

    starts: arm -> the arm whose round 0 it begins with, None for its own. envs: arm -> its environment, the same for
    all where there is a baseline. experts: name -> test.
    """

    file: StudyFile
    arms: Mapping[str, ArmOptions]
    starts: Mapping[str, str | None]
    rule: Rule
    within: tuple[Rule, ...]
    baseline: str | None
    envs: Mapping[str, EnvConfig]
    experts: Mapping[str, ExpertTest]


def read_plan(path: Path, training_seeds: int | None, trust: bool = False) -> Plan:
    """Return the study in `path`; training_seeds: in place of the file's. trust: of its runs.

    Raises `UsageError` in one line for what is not sound.
    """
    from manip_il.evaluation.rounds import Rule

    file = from_yaml(path, StudyFile)
    if training_seeds is not None:
        file = replace(file, training_seeds=training_seeds)
    check_values(file, "")
    if not file.arms:
        raise UsageError(f"{path}: arms is empty; expected a mapping of names to options of manip-il dagger")
    arms: dict[str, ArmOptions] = {}
    starts: dict[str, str | None] = {}
    envs: dict[str, EnvConfig] = {}
    for name in file.arms:
        with _named(path, name):
            checks.name("its name, which becomes a folder,", name)
            options = read_arm((f"{path}: common", file.common), (f"{path}: arms.{name}", file.arms[name]))
            start = starts[name] = first_arm(options, arms)
            if isinstance(options, DaggerOptions):
                options = replace(options, trust=trust)
                envs[name] = options.config().env
            elif start is not None:
                envs[name] = learning_env(start, envs[start])
        arms[name] = options
    experts = {name: _expert_test(f"{path}: expert.{name}", file.expert[name]) for name in file.expert}
    rule, within = Rule.parse(file.checkpoint, file.at), tuple(Rule.parse("best", one) for one in file.within)
    if any(one.amount is None for one in within):
        raise UsageError(f"{path}: within is {file.within}; expected costs with an amount, such as steps:20000")
    return Plan(file, arms, starts, rule, within, _baseline(file, envs), envs, experts)


def _baseline(file: StudyFile, envs: Mapping[str, EnvConfig]) -> str | None:
    """The arm that others are compared with; None if tasks differ and none is named."""
    from manip_il.evaluation.arm import require_same_env

    if file.baseline is None and len({env.task for env in envs.values()}) > 1:
        return None
    first = next(iter(envs))
    for name, env in envs.items():
        require_same_env(f"arm {first!r}", envs[first], f"arm {name!r}", env)
    if file.baseline is not None and file.baseline not in envs:
        raise UnknownName("arm as a baseline", file.baseline, envs)
    return file.baseline or first


def keep_file(folder: Path, file: StudyFile) -> None:
    """Write the study's file beside its runs.

    Raises `MismatchError` if another one is there already; training seeds may be more.
    """
    path = folder / STUDY_FILE
    if path.is_file():
        before = from_yaml(path, StudyFile)
        if replace(before, training_seeds=max(before.training_seeds, file.training_seeds)) != file:
            was, now = to_plain(before), to_plain(file)
            names = ", ".join(name for name in now if was[name] != now[name])
            raise MismatchError(names, str(path), "another", "the file", "its own; give another --output_dir")
    write_file(path, dump_yaml(file).encode())


def _expert_test(origin: str, tree: Any) -> ExpertTest:
    test = from_layers(ExpertTest, [(origin, tree)])
    check_values(test, f"{origin}: ")
    if test.vary and test.suite != "nominal":
        raise UsageError(f"{origin}: has suite and vary; expected one of them")
    return test


@contextmanager
def _named(path: Path, arm: str) -> Generator[None]:
    """Add the file and the arm to an error that does not name them."""
    try:
        yield
    except ManipError as error:
        if str(path) not in str(error):
            error.args = (f"{path}: arm {arm!r}: {error}",)
        raise


def read_arm(common: tuple[str, Any], own: tuple[str, Any]) -> ArmOptions:
    """Return an arm's options; each argument is an origin, for errors, and a tree. common: of `manip-il dagger` alone.

    Raises `UsageError` for an option that is none, or that the study sets; `UnknownName` for an algorithm.
    """
    origin, tree = own
    for said in (common, own):
        if name := next((name for name in OWN if name in (said[1] if isinstance(said[1], dict) else ())), None):
            raise UsageError(f"{said[0]}: {name} is set by the study itself, for every run; take it out")
    if not isinstance(tree, dict) or ALGORITHM not in tree:
        return from_layers(DaggerOptions, [common, own])
    name = str(tree[ALGORITHM])
    if name not in ALGORITHMS:
        raise UnknownName("algorithm", name, ALGORITHMS)
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
    from manip_il.tasks.config import make_config  # here, as help needs no simulator

    known = make_config(env.robot, env.task, env.control_hz, object=env.object)
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
    from manip_il.evaluation.rounds import METRICS_FILE, history

    if isinstance(options, DaggerOptions):
        return own
    records = read_lines(run / METRICS_FILE)
    start = history(records, str(run))[0]
    fitted = start.seconds if options.init is not None else float(records[0]["seconds"]["collect"])
    return tuple(one.after(start, fitted=fitted) for one in own)
