"""Policies tried on the same seeds under the same suite, and films of their episodes."""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import manip_il
from manip_il.cli.progress import Stages, warn
from manip_il.errors import ManipError, MismatchError, NoEffect, RenderError, UnknownName, UsageError
from manip_il.option import option
from manip_il.stock.table import ROBOT, STOCK

if TYPE_CHECKING:
    from manip_il.collect.job import RolloutJob
    from manip_il.collect.workers import Engine
    from manip_il.evaluation.report_data import Film, Paths, Strip
    from manip_il.evaluation.results import EvalResult
    from manip_il.mdp import Episode
    from manip_il.sim.conditions import Condition
    from manip_il.sim.config import EnvConfig

FOLDER = "evaluations"
FILM_EVERY = 2  # control steps a frame of film
SUITES = {
    "nominal": ("nominal",),
    "disturbed": ("knocked", "sensing", "late"),
    "randomised": ("object", "view", "clutter", "dynamics"),
    "all": ("nominal", "knocked", "sensing", "late", "object", "view", "clutter", "dynamics"),
}
CONDITIONS = (*SUITES["all"], "random_actions")
_YAML = (".yaml", ".yml")
_NAMED = "object, dynamics, knocked, sensing, random_actions; with cameras view, clutter, late"
VARY_HELP = f"how worlds differ from episode to episode: {_NAMED}, or YAMLs of ranges"
SUITE_HELP = f"nominal, disturbed, randomised, all; one condition of {_NAMED}; or a YAML of ranges"


@dataclass
class TrialGroup:
    """`--eval.*` of policies that are compared."""

    n_episodes: int = option(500, "test episodes, the same for both sides")


@dataclass(frozen=True)
class Trial:
    """Environment, seeds and conditions of tests; trust: whether models that checkpoints name may be loaded."""

    env: EnvConfig
    seeds: range
    suite: str = "nominal"
    conditions: tuple[Condition, ...] = ()
    trust: bool = False

    @classmethod
    def of(cls, env: EnvConfig, seeds: range, suite: str, policies: Iterable[Path], trust: bool = False) -> Trial:
        """Make one of a suite's conditions, without those of cameras where none of the policies uses any."""
        from manip_il.learn.policy_files import policy_cameras

        sees = any(policy_cameras(policy) is not None for policy in policies)
        return cls(env, seeds, suite, suite_conditions(suite, env.task, env.object, sees=sees), trust)

    def job(self, policy: Path | None) -> RolloutJob:
        """Return the rollouts of one policy; None: of the expert."""
        from manip_il.collect.drivers import ExpertDriver, PolicyDriver
        from manip_il.collect.job import RolloutJob
        from manip_il.evaluation.runner import HOLD

        driver = ExpertDriver() if policy is None else PolicyDriver((policy,), trust=self.trust)
        return RolloutJob(self.env, driver, episode_hold(self.env, HOLD), label="last", conditions=self.conditions)

    def file(self, folder: Path, policy: Path | None) -> Path:
        """Return the file of a policy's or the expert's evaluation, named after its files, environment and episodes.

        So another policy of the same name is another file, and what was measured before stays true.
        """
        from manip_il.collect.environments import env_fingerprint
        from manip_il.data.fingerprint import canonical_json
        from manip_il.evaluation.results import EvalSettings
        from manip_il.learn.policy_files import policy_sha256

        settings = EvalSettings.of(self.job(policy), self.suite).to_json()
        made_of = (
            env_fingerprint(self.env),
            self.seeds.start,
            len(self.seeds),
            settings,
            policy and policy_sha256(policy),
        )
        return folder / FOLDER / f"{hashlib.sha256(canonical_json(made_of).encode()).hexdigest()[:16]}.json"

    def measure(
        self, policy: Path | None, name: str, file: Path, engine: Engine, stages: Stages, *, complete: bool = True
    ) -> EvalResult:
        """Return the evaluation of a policy from its file, which is made first where it is not there.

        name: in progress and results. complete: raise `ManipError` where workers died of a seed, which leaves it out.
        """
        from manip_il.evaluation.results import EvalResult
        from manip_il.evaluation.runner import evaluate

        if not file.is_file():
            stages.start(f"test {name}{'' if self.suite == 'nominal' else ', ' + self.suite}", len(self.seeds))
            result = evaluate(engine, self.job(policy), self.seeds, name, stages.episode, suite=self.suite)
            stages.close()
            if complete and len(result.episodes) < len(self.seeds):
                have = f"{len(result.episodes)} of {len(self.seeds)}"
                raise ManipError(f"{name} has {have} test episodes, because workers died")
            result.write(file)
        return EvalResult.read(file)

    def check_result(self, name: str, result: EvalResult) -> None:
        """Raise `MismatchError` or `ManipError` unless a given evaluation is of this trial."""
        from manip_il.evaluation.results import EvalSettings

        settings = EvalSettings.of(self.job(Path()), self.suite)
        for what, value in {"robot": self.env.robot, "task": self.env.task, "settings": settings}.items():
            if getattr(result, what) != value:
                raise MismatchError(what, name, getattr(result, what), "this comparison", value)
        theirs = {episode.seed for episode in result.episodes}
        if theirs != set(self.seeds):
            raise ManipError(
                f"test episodes differ: {name} has {len(theirs)}, this comparison {len(self.seeds)}, of which "
                f"{len(theirs & set(self.seeds))} are the same; give its --seed and --eval.n_episodes here"
            )

    def check_policies(self, policies: dict[str, Path], folder: Path, engine: str) -> None:
        """Raise, before any episode runs, where one of the policies (name -> folder) cannot be measured."""
        from manip_il.cli.inputs import check_policy
        from manip_il.learn.checkpoint import Checkpoint

        for name, policy in policies.items():
            if not self.file(folder, policy).is_file():
                checkpoint = Checkpoint.open(policy)
                meta = checkpoint.origin
                if meta is not None and meta.task != self.env.task:
                    raise MismatchError("task", name, meta.task, "the comparison", self.env.task)
                check_policy(checkpoint, self.env, draw=engine == "local", trust=self.trust)


def suite_conditions(suite: str, task: str, shape: str = "", *, sees: bool) -> tuple[Condition, ...]:
    """Return the conditions of a suite, in the order in which seeds take turns.

    Without those that change nothing: for a task without an object, or (`sees` false) for what looks at no camera; with
    sizes that the task can take. Raises `UnknownName` for a suite, `UsageError` for a file that is not one or where
    nothing is left.
    """
    asked = [read_condition(name) for name in SUITES.get(suite, (suite,))]
    left = [one for condition in asked if (one := for_task(condition, task, shape, sees=sees)) is not None]
    if not left:
        blind = "" if sees else " and a policy without cameras"
        raise NoEffect(f"--suite={suite} changes nothing for {task}{blind}; choose another suite")
    return tuple(left)


def varied(names: Sequence[str], env: EnvConfig, *, sees: bool) -> tuple[Condition, ...]:
    """Return what `--vary` names as one condition, from which every episode draws; none for no names.

    Raises `UnknownName` for another name, `UsageError` for what is no YAML of ranges or changes nothing here.
    """
    from manip_il.sim.conditions import merged

    if not names:
        return ()
    if odd := next((name for name in names if name not in CONDITIONS[1:] and not name.endswith(_YAML)), None):
        raise UnknownName("--vary", odd, CONDITIONS[1:])
    kept = for_task(merged([read_condition(name) for name in names]), env.task, env.object, sees=sees)
    if kept is None:
        raise NoEffect(f"--vary={','.join(names)} changes nothing for {env.task}{'' if sees else ' without cameras'}")
    return (kept,)


def for_task(condition: Condition, task: str, shape: str = "", *, sees: bool) -> Condition | None:
    """Return what of a condition has an effect on a task with an object of a shape, see `Condition.for_world`."""
    from manip_il.sim.shape import draws_shape
    from manip_il.tasks.table import get_task
    from manip_il.tasks.task import TakesShape

    if task in STOCK:  # which takes none
        return None if condition.ranges else condition
    the_task = get_task(task, shape)
    if "shape" in condition.ranges and isinstance(the_task, TakesShape) and not draws_shape(shape):
        raise UsageError(
            f"{condition.name}: shape is drawn where --task.object is any, not {shape or 'a cube'}; say so"
        )
    return condition.for_world(has_object=bool(the_task.objects), sees=sees, sizes=the_task.sizes, shape=shape)


def episode_hold(env: EnvConfig, hold: int | None) -> int | None:
    """Return how long after success an evaluation's episodes end; stock environments run to their own end."""
    return None if env.robot == ROBOT else hold


def require_suite(suite: str) -> None:
    """Raise `UnknownName` for an unknown suite, `UsageError` for a missing file; nothing is read."""
    if suite.endswith(_YAML):
        if not Path(suite).is_file():
            raise UsageError(f"--suite={suite}: no such file; expected a YAML of ranges")
    elif suite not in (*SUITES, *CONDITIONS):
        raise UnknownName("suite", suite, [*SUITES, *CONDITIONS[1:]])


def read_condition(name: str) -> Condition:
    """Return a condition by its name, or a YAML of ranges by its path; `UsageError` names what is wrong with it."""
    from manip_il.checks import read_yaml
    from manip_il.sim.conditions import Condition

    require_suite(name)
    path = Path(name) if name.endswith(_YAML) else _suites_folder() / f"{name}.yaml"
    tree = read_yaml(path, "a YAML of ranges")
    if not isinstance(tree, dict | None):
        raise UsageError(f"{path} holds {type(tree).__name__}; expected a mapping of names to ranges")
    return Condition.from_mapping(path.stem, tree or {})


def _suites_folder() -> Path:
    """Return the suites' folder: beside the package in a checkout, else where an installation puts data."""
    places = (Path(manip_il.__file__).parents[1] / "configs", Path(sys.prefix) / "share" / "manip_il")
    for place in places:
        if (place / "suites" / "nominal.yaml").is_file():
            return place / "suites"
    raise ManipError(f"the suites' YAML files are missing; looked in {' and '.join(map(str, places))}; install again")


@dataclass(frozen=True)
class Shot:
    """One episode to show. success: how the picture is marked, None for no mark."""

    job: RolloutJob
    episode: Episode
    title: str
    caption: str = ""
    success: bool | None = None

    @classmethod
    def of(cls, job: RolloutJob, episode: Episode) -> Shot:
        """Show an episode with its outcome, seed, and the condition where not nominal: `Seed 4000000, knocked`."""
        from manip_il.sim.conditions import NOMINAL, draw

        condition = draw(job.conditions or (NOMINAL,), episode.seed).condition
        title = f"Seed {episode.seed}" + ("" if condition == NOMINAL.name else f", {condition}".lower())
        return cls(job, episode, title, success=episode.success)

    def film(self, *, strip: bool = False) -> tuple[Film, Strip | None]:
        """Return the episode as it looked, as a strip of pictures too. Raises `RenderError` without OpenGL."""
        from manip_il.evaluation.film import film, make_film, pictures_of
        from manip_il.evaluation.report_data import Strip

        frames = film(self.episode, self.job.env, every=FILM_EVERY)
        fps = self.job.env.control_hz // FILM_EVERY or 1
        made = make_film(self.title, frames, fps, self.caption, success=self.success)
        return made, Strip(self.title, pictures_of(frames, fps), self.caption) if strip else None

    def paths(self) -> Paths:
        """Return the paths of hand and object."""
        from manip_il.collect.environments import env_spec
        from manip_il.evaluation.film import paths

        return replace(paths(self.episode, env_spec(self.job.env), self.title, self.caption), success=self.success)


@dataclass(frozen=True)
class Pictures:
    """Films and strips of episodes, or their paths and a note why there are no films."""

    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    note: str = ""


def film_shots(shots: Sequence[Shot], stages: Stages, *, strips: bool = False) -> Pictures:
    """Return every episode as a film, and a strip if wanted, or all as paths, with a warning, without OpenGL."""
    made: list[tuple[Film, Strip | None]] = []
    try:
        for shot in shots:
            made.append(shot.film(strip=strips))
            stages.step()
    except RenderError as error:
        warn(f"the report shows paths in place of films: {error}")
        return Pictures(paths=tuple(shot.paths() for shot in shots), note=str(error))
    finally:
        stages.close()
    return Pictures(tuple(film for film, _ in made), tuple(strip for _, strip in made if strip))
