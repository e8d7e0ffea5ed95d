"""Films of episodes, rendered from their recorded states."""

import io
from collections.abc import Iterable, Sequence
from typing import Any

import av
import numpy as np
from numpy.typing import NDArray

from manip_il.collect.edits import render_states
from manip_il.collect.job import RolloutJob
from manip_il.collect.workers import Engine
from manip_il.data import schema
from manip_il.errors import RenderError, warn
from manip_il.evaluation.report import Film
from manip_il.evaluation.results import EvalResult
from manip_il.mdp import Episode
from manip_il.progress import Progress
from manip_il.sim.config import FILM, CameraConfig
from manip_il.worlds.config import EnvConfig
from manip_il.worlds.contract import Unable
from manip_il.worlds.table import env_spec

FILM_EVERY = 2  # control steps per frame of film
_SIZE = (240, 320)  # height and width [pixels]


def film_states(
    env: EnvConfig, states: NDArray[Any], every: int, size: tuple[int, int] = _SIZE
) -> bytes:
    """Return an MP4 of an environment's states, in real time.

    Args:
        env: The environment, filmed by the first of its default cameras.
        states: States of consecutive control steps, rows of `sim_state`, (N, m).
        every: Control steps per frame of film.
        size: Height and width [pixels].

    Raises:
        RenderError: if there is no off-screen OpenGL.
        Unable: if the environment cannot be drawn.
    """
    spec = env_spec(env)
    spec.require("drawn", "there is no film of it")
    camera = spec.default_cameras[0]
    pictures = render_states(env, CameraConfig((camera,), *size, FILM), states[::every])
    return encode_mp4(list(pictures[schema.IMAGES + camera]), env.control_hz / every)


def film_episode(env: EnvConfig, episode: Episode, title: str = "", caption: str = "") -> Film:
    """Return a film of an episode, with every `FILM_EVERY`-th control step as a frame.

    Args:
        env: The environment of the episode.
        episode: The episode, with its states.
        title: The film's title in the report.
        caption: The text below the film.

    Raises:
        RenderError: if there is no off-screen OpenGL.
        Unable: if the environment cannot be drawn.
    """
    return Film(title, film_states(env, episode.columns[schema.SIM_STATE], FILM_EVERY), caption)


def collect_films(made: Iterable[Film], progress: Progress) -> list[Film]:
    """Return the films; without off-screen OpenGL none, and log the reason."""
    films: list[Film] = []
    try:
        for film in made:
            films.append(film)
            progress.step()
    except (RenderError, Unable) as error:
        warn(f"the report has no films: {error}")
        return []
    finally:
        progress.close()
    return films


def film_outcomes(
    engine: Engine, job: RolloutJob, result: EvalResult, most: int, progress: Progress
) -> list[Film]:
    """Rerun and film some failed and some successful episodes of an evaluation.

    Args:
        engine: What runs the episodes.
        job: The rollouts of the evaluation.
        result: The evaluation.
        most: Largest number of failures to film, and of successes; 0 for no films.
        progress: Follows the filming.

    Returns:
        What `collect_films` returns.
    """
    shown = [
        one
        for good in (False, True)
        for one in [e for e in result.episodes if e.success == good][:most]
    ]
    if not shown:
        return []
    progress.start("films", len(shown))
    episodes = {episode.seed: episode for episode in engine.run(job, [one.seed for one in shown])}
    made = (
        film_episode(
            job.env,
            episodes[one.seed],
            "Success" if one.success else "Failure",
            f"seed {one.seed}, {one.condition}".rstrip(", "),
        )
        for one in shown
    )
    return collect_films(made, progress)


def encode_mp4(frames: Sequence[NDArray[np.uint8]], fps: float) -> bytes:
    """Return an MP4 that browsers play: H.264, 4:2:0.

    Args:
        frames: At least one RGB picture, uint8 (height, width, 3); height and width must be even.
        fps: Rate of the video [frames/s].
    """
    buffer = io.BytesIO()
    with av.open(buffer, "w", format="mp4") as container:
        stream = container.add_stream(
            "libx264", rate=schema.exact_rate(fps), options={"crf": "24", "preset": "medium"}
        )
        stream.height, stream.width = frames[0].shape[:2]
        stream.pix_fmt = "yuv420p"
        for picture in frames:
            container.mux(
                stream.encode(
                    av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")
                )
            )
        container.mux(stream.encode())
    return buffer.getvalue()
