"""What an evaluation shows of its episodes: films of failures and successes, or paths where there is no OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.cli.folders import atomic_write
from manip_il.cli.groups import warn
from manip_il.errors import ManipError, RenderError

if TYPE_CHECKING:
    from manip_il.cli.stages import Stages
    from manip_il.engine.engine import Engine
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.report_data import Film, LearningCurve, Paths
    from manip_il.evaluation.results import EvalResult
    from manip_il.mdp import Episode

FILMS = "films"
FILM_EVERY = 2  # control steps a film's frame: half the pictures, and still fluent


@dataclass(frozen=True)
class Shown:
    """Failures first. note: why there are paths and no films."""

    films: tuple[Film, ...] = ()
    paths: tuple[Paths, ...] = ()
    note: str = ""


def show(job: RolloutJob, result: EvalResult, engine: Engine, stages: Stages, count: int, folder: Path) -> Shown:
    """Run the first `count` failures and as many successes again and film them, also into `folder`/films."""
    seeds = chosen_seeds(result, count)
    if not seeds:
        return Shown()
    stages.start("films", len(seeds))
    episodes = {episode.seed: episode for episode in engine.run(replace(job, label="last"), seeds)}
    try:
        films: list[Film] = []
        for seed in seeds:
            films.append(film_episode(job, episodes[seed]))
            outcome = "success" if episodes[seed].success else "failure"
            atomic_write(folder / FILMS / f"seed_{seed}_{outcome}.mp4", films[-1].mp4)
            stages.step()
        return Shown(films=tuple(films))
    except RenderError as error:
        warn([f"the report shows paths in place of films: {error}"])
        return Shown(paths=tuple(_paths(job, episodes[seed]) for seed in seeds), note=str(error))
    finally:
        stages.close()


def chosen_seeds(result: EvalResult, count: int) -> list[int]:
    """Return the first `count` seeds that failed, then as many that succeeded."""
    by_outcome = [[one.seed for one in result.episodes if one.success == outcome] for outcome in (False, True)]
    return [seed for seeds in by_outcome for seed in seeds[:count]]


def film_episode(job: RolloutJob, episode: Episode) -> Film:
    """Return the episode as it looked. Raises `RenderError` where there is no OpenGL."""
    from manip_il.evaluation.film import film, make_film
    from manip_il.sim.conditions import NOMINAL, draw

    met = draw(job.conditions or (NOMINAL,), episode.seed)
    frames = film(episode, job.env, every=FILM_EVERY, drawn=met)
    fps = job.env.control_hz // FILM_EVERY or 1
    return make_film(caption(job, episode).capitalize(), frames, fps, success=episode.success)


def caption(job: RolloutJob, episode: Episode) -> str:
    """Seed, and what it met where that is not nominal."""
    from manip_il.sim.conditions import NOMINAL, draw

    met = draw(job.conditions or (NOMINAL,), episode.seed).condition
    return f"seed {episode.seed}" + ("" if met == NOMINAL.name else f", {met}")


def run_curve(policy: Path | None) -> LearningCurve | None:
    """Return the learning curve of the DAgger run that a policy lies in; None where it lies in none."""
    from manip_il.algorithms.table import ALGORITHMS
    from manip_il.cli.dagger import METRICS_FILE, DaggerOptions, learning_curve
    from manip_il.cli.groups import CONFIG_FILE
    from manip_il.cli.options import from_yaml

    places: Sequence[Path] = [] if policy is None else [policy, *policy.resolve().parents[:5]]
    for folder in places:
        if (folder / METRICS_FILE).is_file():
            try:
                return learning_curve(folder, ALGORITHMS[from_yaml(folder / CONFIG_FILE, DaggerOptions).method].title)
            except (ManipError, KeyError):  # of another command, which counts no labels
                return None
    return None


def _paths(job: RolloutJob, episode: Episode) -> Paths:
    from manip_il.engine.environments import env_spec
    from manip_il.evaluation.film import paths

    shown = paths(episode, env_spec(job.env), caption(job, episode).capitalize())
    return replace(shown, success=episode.success)
