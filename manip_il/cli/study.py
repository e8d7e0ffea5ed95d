"""A study of `manip-il compare`: runs of several arms with the same training seeds, and their tests.

An arm is `manip-il dagger`, or an algorithm that starts from round 0 of such an arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from manip_il import checks
from manip_il.cli.common_options import DatasetRoots, EngineOptions, TrialGroup
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.learning import AirlOptions, GailOptions, PpoOptions
from manip_il.cli.options import Open, group
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.parsing import from_layers, from_yaml
from manip_il.cli.progress import say
from manip_il.data.json_lines import read_lines
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.arm import Arm, Member, read_member, require_same_env
from manip_il.evaluation.comparison import TARGET
from manip_il.evaluation.rounds import METRICS_FILE, At, history
from manip_il.option import option
from manip_il.seeding import MAX_SEED
from manip_il.tasks.config import EnvConfig

ROUND_0 = "round_000"
ALGORITHM = "algorithm"  # the key of an arm that names one of ALGORITHMS
ALGORITHMS = {"gail": GailOptions, "airl": AirlOptions, "ppo": PpoOptions}
ArmOptions = DaggerOptions | GailOptions | PpoOptions  # an AirlOptions is a GailOptions
OWN = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")  # options of a run that the study sets
EPISODES = 500  # test episodes


@dataclass(frozen=True)
class StudyFile:
    """Content of a study's YAML file.

    common: options of `manip-il dagger` that all its arms share. arms: name -> options in which an arm differs; with
    `algorithm: gail`, `airl` or `ppo` those of that command, in which `dataset.root` and `init` name another arm. If
    tasks differ, nothing is compared.
    """

    common: Open = field(default_factory=dict[str, Any])
    arms: Open = field(default_factory=dict[str, Any])
    training_seeds: int = option(3, "runs of every arm", at_least=1, at_most=MAX_SEED, grows=True)
    eval: TrialGroup = group(TrialGroup(EPISODES))
    checkpoint: Literal["best", "last"] = "best"
    at: At = "end"
    baseline: str | None = option(None, "the arm to compare others with; by default the first")
    target: float = option(TARGET, "validation success for which the cost is reported", at_least=0.0, at_most=1.0)


@dataclass(frozen=True)
class StudyPlan:
    """A checked study: the options of every arm are valid.

    starts: arm -> the arm whose round 0 it starts from, which may be itself. envs: arm -> its environment, the same for
    all if there is a baseline.
    """

    file: StudyFile
    arms: Mapping[str, ArmOptions]
    starts: Mapping[str, str]
    baseline: str | None
    envs: Mapping[str, EnvConfig]


def read_plan(path: Path, training_seeds: int | None, trust: bool = False) -> StudyPlan:
    """Return the study in `path`. training_seeds: replaces the file's. trust: option of its runs.

    Raises a one-line `UsageError` if something is invalid.
    """
    file = from_yaml(path, StudyFile)
    if training_seeds is not None:
        file = replace(file, training_seeds=training_seeds)
    if not file.arms:
        raise UsageError(f"{path}: arms is empty; expected a mapping of names to options of manip-il dagger")
    arms, starts, envs = dict[str, ArmOptions](), dict[str, str](), dict[str, EnvConfig]()
    for name in file.arms:
        try:
            checks.name("its name, which becomes a folder,", name)
            options = read_arm(file.common, file.arms[name])
            if isinstance(options, DaggerOptions):
                options = replace(options, trust=trust)
                starts[name], envs[name] = name, options.config().env
            else:
                starts[name] = _first_arm(options, [one for one in arms if starts[one] == one])
                envs[name] = envs[starts[name]]
        except ManipError as error:
            raise UsageError(f"{path}: arm {name!r}: {error}") from error
        arms[name] = options
    return StudyPlan(file, arms, starts, _baseline(file, envs), envs)


def read_arm(common: Mapping[str, Any], own: Any) -> ArmOptions:
    """Return an arm's options. common: options of `manip-il dagger` only.

    Raises `UsageError` for an option that is unknown or set by the study; `UnknownName` for an unknown algorithm.
    """
    layers = [("common", common), ("its options", own)]
    if set_here := next((name for name in OWN for _, tree in layers if isinstance(tree, dict) and name in tree), None):
        raise UsageError(f"{set_here} is set by the study for every run; remove it")
    if not isinstance(own, dict) or ALGORITHM not in own:
        return from_layers(DaggerOptions, layers)
    name = str(own[ALGORITHM])
    if name not in ALGORITHMS:
        raise UnknownName("algorithm", name, ALGORITHMS)
    return from_layers(ALGORITHMS[name], [("its options", {key: own[key] for key in own if key != ALGORITHM})])


def _first_arm(options: GailOptions | PpoOptions, known: list[str]) -> str:
    """Return the arm that an arm with an algorithm starts from, which `dataset.root` and `init` name instead of a path.

    known: earlier arms of `manip-il dagger`. Raises `UsageError` for any other.
    """
    roots = options.dataset.root if isinstance(options, GailOptions) else []
    named = {str(path) for path in (*roots, options.init) if path is not None}
    if len(named) != 1 or not named <= {*known}:
        raise UsageError(
            f"dataset.root and init are {', '.join(sorted(named)) or 'not given'}; expected the name of one earlier "
            f"arm of manip-il dagger, to start from its demonstrations and policy: {', '.join(known) or 'none'}"
        )
    return named.pop()


def _baseline(file: StudyFile, envs: Mapping[str, EnvConfig]) -> str | None:
    """Return the arm to compare others with; None if tasks differ and none is named."""
    if file.baseline is None and len({env.task for env in envs.values()}) > 1:
        return None
    require_same_env(envs)
    if file.baseline is not None and file.baseline not in envs:
        raise UnknownName("arm as a baseline", file.baseline, envs)
    return file.baseline or next(iter(envs))


def run_arms(plan: StudyPlan, root: Path, engine: EngineOptions) -> None:
    """Run missing runs, seed by seed, so that a study that is stopped early has all arms."""
    runs = [(name, seed) for seed in range(plan.file.training_seeds) for name in plan.arms]
    for number, (name, seed) in enumerate(runs, start=1):
        folder = _folder(root, name, seed)
        if not (folder / REPORT_FILE).is_file():  # a run's last file
            say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
            options = with_start_policy(plan.arms[name], _folder(root, plan.starts[name], seed) / ROUND_0)
            settings, output = options.settings | {"seed": seed}, ResumableOutput(folder, resume=True)
            replace(options, settings=settings, output=output, engine=engine).run()


def read_arms(plan: StudyPlan, root: Path) -> tuple[Arm, ...]:
    """Return the runs of every arm."""
    seeds = range(plan.file.training_seeds)
    return tuple(Arm(name, tuple(_member(plan, root, name, seed) for seed in seeds)) for name in plan.arms)


def with_start_policy(options: ArmOptions, start: Path) -> ArmOptions:
    """Return an arm's options with the demonstrations and policy of round 0, `start`, instead of an arm's name."""
    if isinstance(options, DaggerOptions):
        return options
    options = replace(options, init=options.init and start / "policy")
    return replace(options, dataset=DatasetRoots([start / "dataset"])) if isinstance(options, GailOptions) else options


def with_start_cost(options: ArmOptions, own: Member, run: Path) -> Member:
    """Return an arm's member with the costs of its start: round 0 in `run`, including its fit if `init` is given."""
    if isinstance(options, DaggerOptions):
        return own
    records = read_lines(run / METRICS_FILE)
    start = history(records, str(run))[0]
    fitted = start.seconds if options.init is not None else float(records[0]["seconds"]["collect"])
    return replace(own, history=tuple(one.after(start, fitted=fitted) for one in own.history))


def _member(plan: StudyPlan, root: Path, name: str, seed: int) -> Member:
    run = replace(read_member(_folder(root, name, seed)), training_seed=seed)
    return with_start_cost(plan.arms[name], run, _folder(root, plan.starts[name], seed))


def _folder(root: Path, name: str, seed: int) -> Path:
    return root / name / f"seed_{seed}"
