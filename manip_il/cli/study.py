"""A study of `manip-il compare`: runs of `manip-il dagger` with several arms, each with the same training seeds."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from manip_il import checks
from manip_il.cli.common_options import EngineOptions, TrialGroup
from manip_il.cli.dagger import DaggerOptions
from manip_il.cli.options import Open
from manip_il.cli.outputs import REPORT_FILE, ResumableOutput
from manip_il.cli.parsing import from_layers, from_yaml
from manip_il.cli.progress import say
from manip_il.errors import ManipError, UnknownName, UsageError
from manip_il.evaluation.arm import Arm, read_arm, require_same_env
from manip_il.evaluation.comparison import TARGET
from manip_il.evaluation.rounds import At
from manip_il.option import option
from manip_il.seeding import MAX_SEED
from manip_il.tasks.config import EnvConfig

OWN = ("seed", "output_dir", "resume", "overwrite", "workers", "engine")  # options of a run that the study sets


@dataclass(frozen=True)
class StudyFile:
    """Content of a study's YAML file.

    common: options of `manip-il dagger` that all arms share. arms: name -> options in which an arm differs. If tasks
    differ, nothing is compared.
    """

    common: Open = field(default_factory=dict[str, Any])
    arms: Open = field(default_factory=dict[str, Any])
    training_seeds: int = option(3, "runs of every arm", at_least=1, at_most=MAX_SEED, grows=True)
    eval: TrialGroup = field(default_factory=TrialGroup)
    checkpoint: Literal["best", "last"] = "best"
    at: At = "end"
    baseline: str | None = option(None, "the arm to compare others with; by default the first")
    target: float = option(TARGET, "validation success for which the cost is reported", at_least=0.0, at_most=1.0)


@dataclass(frozen=True)
class StudyPlan:
    """A checked study: the options of every arm are valid.

    envs: arm -> its environment, the same for all if there is a baseline.
    """

    file: StudyFile
    arms: Mapping[str, DaggerOptions]
    envs: Mapping[str, EnvConfig]
    baseline: str | None


def read_plan(path: Path, training_seeds: int | None, trust: bool = False) -> StudyPlan:
    """Return the study in `path`. training_seeds: replaces the file's. trust: option of its runs.

    Raises a one-line `UsageError` if something is invalid.
    """
    file = from_yaml(path, StudyFile)
    if training_seeds is not None:
        file = replace(file, training_seeds=training_seeds)
    if not file.arms:
        raise UsageError(f"{path}: arms is empty; expected a mapping of names to options of manip-il dagger")
    arms, envs = dict[str, DaggerOptions](), dict[str, EnvConfig]()
    for name, own in file.arms.items():
        try:
            checks.name("its name, which becomes a folder,", name)
            arms[name] = replace(_read_options(file.common, own), trust=trust)
            envs[name] = arms[name].config().env
        except ManipError as error:
            raise UsageError(f"{path}: arm {name!r}: {error}") from error
    return StudyPlan(file, arms, envs, _baseline(file, envs))


def _read_options(common: Any, own: Any) -> DaggerOptions:
    """Return an arm's options. Raises `UsageError` for an option that is unknown or set by the study."""
    layers = [("common", common), ("its options", own)]
    if set_here := next((name for name in OWN for _, tree in layers if name in (tree or {})), None):
        raise UsageError(f"{set_here} is set by the study for every run; remove it")
    return from_layers(DaggerOptions, layers)


def _baseline(file: StudyFile, envs: Mapping[str, EnvConfig]) -> str | None:
    """Return the arm to compare others with; None if tasks differ and none is named."""
    if file.baseline is None and len({env.task for env in envs.values()}) > 1:
        return None
    require_same_env(envs)
    if file.baseline is not None and file.baseline not in envs:
        raise UnknownName("arm as a baseline", file.baseline, envs)
    return file.baseline or next(iter(envs))


def run_arms(plan: StudyPlan, root: Path, engine: EngineOptions) -> tuple[Arm, ...]:
    """Run missing runs, seed by seed, so that a study that is stopped early has all arms; return all arms."""
    runs = [(name, seed) for seed in range(plan.file.training_seeds) for name in plan.arms]
    for number, (name, seed) in enumerate(runs, start=1):
        output = ResumableOutput(root / name / f"seed_{seed}", resume=True)
        if not (output.output_dir / REPORT_FILE).is_file():  # a run's last file
            say(f"run {number} of {len(runs)}: {name}, training seed {seed}")
            options = plan.arms[name]
            replace(options, settings=options.settings | {"seed": seed}, output=output, engine=engine).run()
    return tuple(replace(read_arm(root / name), name=name) for name in plan.arms)
