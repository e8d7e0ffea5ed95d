"""Films of episodes, or the paths of hand and object where there is no OpenGL."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

from manip_il.cli.progress import Stages, warn
from manip_il.errors import RenderError

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.report_data import Film, Paths, Strip
    from manip_il.mdp import Episode

FILM_EVERY = 2  # control steps a frame of film


@dataclass(frozen=True)
class Shot:
    """One episode to show. success: how the picture is marked, None for no mark."""

    job: RolloutJob
    episode: Episode
    title: str
    caption: str = ""
    success: bool | None = None

    def film(self) -> tuple[Film, Strip]:
        """Return the episode as it looked. Raises `RenderError` where there is no OpenGL."""
        from manip_il.evaluation.film import film, make_film, strip
        from manip_il.evaluation.report_data import Strip
        from manip_il.sim.conditions import NOMINAL, draw

        drawn = draw(self.job.conditions or (NOMINAL,), self.episode.seed)
        frames = film(self.episode, self.job.env, every=FILM_EVERY, drawn=drawn)
        fps = self.job.env.control_hz // FILM_EVERY or 1
        made = make_film(self.title, frames, fps, self.caption, success=self.success)
        return made, Strip(self.title, strip(frames, fps), self.caption)

    def paths(self) -> Paths:
        """Return the paths of hand and object."""
        from manip_il.engine.environments import env_spec
        from manip_il.evaluation.film import paths

        return replace(paths(self.episode, env_spec(self.job.env), self.title, self.caption), success=self.success)


@dataclass(frozen=True)
class Pictures:
    """Films and strips of episodes, or their paths and a note why there are no films."""

    films: tuple[Film, ...] = ()
    strips: tuple[Strip, ...] = ()
    paths: tuple[Paths, ...] = ()
    note: str = ""


def film_shots(shots: Sequence[Shot], stages: Stages) -> Pictures:
    """Return every episode as a film and a strip, or all as paths, with a warning, where there is no OpenGL."""
    made: list[tuple[Film, Strip]] = []
    try:
        for shot in shots:
            made.append(shot.film())
            stages.step()
    except RenderError as error:
        warn([f"the report shows paths in place of films: {error}"])
        return Pictures(paths=tuple(shot.paths() for shot in shots), note=str(error))
    finally:
        stages.close()
    return Pictures(tuple(film for film, _ in made), tuple(strip for _, strip in made))


def condition_caption(job: RolloutJob, episode: Episode) -> str:
    """Return the seed, and the condition where that is not nominal: `Seed 4000000, knocked`."""
    from manip_il.sim.conditions import NOMINAL, draw

    condition = draw(job.conditions or (NOMINAL,), episode.seed).condition
    return f"Seed {episode.seed}" + ("" if condition == NOMINAL.name else f", {condition}".lower())
