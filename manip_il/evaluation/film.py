"""Pictures of an episode from its recorded states: films, strips, and paths for machines without OpenGL."""

from __future__ import annotations

import io
import tempfile
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Literal

import av
import numpy as np
from numpy.typing import NDArray
from PIL import Image

# First: it chooses the OpenGL that mujoco takes on import.
import manip_il.sim  # noqa: F401  # pyright: ignore[reportUnusedImport]
from manip_il.collect.edits import render_states
from manip_il.collect.job import RolloutJob
from manip_il.data import schema
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError
from manip_il.evaluation.report_data import Film, Paths
from manip_il.mdp import Episode
from manip_il.sim.config import FILM, CameraConfig
from manip_il.sim.env import EnvConfig

AFTER_SUCCESS = 1.0  # filmed after the task is solved [s]
Frames = Sequence[NDArray[np.uint8]]


def run_states(job: RolloutJob, seed: int) -> Episode:
    """Return the episode of one seed, the same as in an evaluation of `job`, with its states."""
    return next(replace(job, label="last").run([seed]))


def film(
    episode: Episode,
    env_config: EnvConfig,
    camera: str = "front",
    size: tuple[int, int] = (240, 320),
    every: int = 1,
) -> list[NDArray[np.uint8]]:
    """Return one picture each `every` control steps, uint8 (height, width, 3), until shortly after success.

    Raises `RenderError` without off-screen OpenGL, `UnknownName` for the camera.
    """
    states = episode.columns[schema.SIM_STATE][: filmed_steps(episode, env_config.control_hz) : every]
    pictures = render_states(env_config, CameraConfig((camera,), *size, FILM), states)
    return list(pictures[schema.IMAGES + camera])


def filmed_steps(episode: Episode, fps: int) -> int:
    """Return how many control steps are filmed: until `AFTER_SUCCESS` after success, else all."""
    solved = episode.columns[schema.SUCCESS].ravel()
    if not solved.any():
        return len(episode)
    return min(len(episode), int(np.argmax(solved)) + 1 + round(AFTER_SUCCESS * fps))


def make_film(policy: str, frames: Frames, fps: int, caption: str = "", success: bool | None = None) -> Film:
    """Return pictures (height, width, 3) as a film; its poster is the last one."""
    return Film(policy, encode_mp4(frames, fps), caption, success, encode_picture(frames[-1], "jpeg"))


def encode_mp4(frames: Frames, fps: int) -> bytes:
    """Return an MP4 that browsers play from its first bytes on: H.264, 4:2:0, index in front.

    frames: uint8 (height, width, 3). Raises `ManipError` for no frames, or an odd height or width, which 4:2:0 forbids.
    """
    if len(frames) == 0:
        raise ManipError("no frames to make a film of")
    height, width = frames[0].shape[:2]
    if height % 2 or width % 2:
        raise ManipError(f"a film of {width} x {height} pixels; expected even numbers")
    with tempfile.TemporaryDirectory() as folder:  # moving the index to the front needs a file that can be read again
        path = Path(folder) / "film.mp4"
        with av.open(path, "w", options={"movflags": "faststart"}) as container:
            stream = container.add_stream("libx264", rate=Fraction(fps), options={"crf": "24", "preset": "medium"})
            stream.width, stream.height, stream.pix_fmt = width, height, "yuv420p"
            for picture in frames:
                container.mux(stream.encode(av.VideoFrame.from_ndarray(np.ascontiguousarray(picture), format="rgb24")))
            container.mux(stream.encode())
        return path.read_bytes()


def pictures_of(frames: Frames, fps: int, count: int = 6) -> tuple[tuple[float, bytes], ...]:
    """Return `count` frames, evenly apart, the first and the last among them: (time [s], PNG)."""
    chosen = np.unique(np.linspace(0, len(frames) - 1, min(count, len(frames))).round().astype(int))
    return tuple((index / fps, encode_picture(frames[index], "png")) for index in chosen.tolist())


def encode_picture(picture: NDArray[np.uint8], kind: Literal["png", "jpeg"]) -> bytes:
    """Return one picture (height, width, 3) as a file; JPEG has a fifth of the size of PNG."""
    buffer = io.BytesIO()
    Image.fromarray(picture).save(buffer, format=kind, optimize=True, **({"quality": 85} if kind == "jpeg" else {}))
    return buffer.getvalue()


def paths(episode: Episode, spec: RobotTaskSpec, policy: str, caption: str = "") -> Paths:
    """Return positions of hand, object and goal, which not every task has; needs no OpenGL.

    Of several objects the one that moves most; the hand again where there is none.
    """
    rows = episode.columns[schema.ENVIRONMENT_STATE][: filmed_steps(episode, spec.fps)].astype(np.float64)
    names = list(spec.environment_state_names)

    def positions(thing: str) -> NDArray[np.float64]:
        return rows[:, [names.index(f"{thing}.{axis}") for axis in "xyz"]]

    hand = positions("ee")
    places = [name.removesuffix(".x") for name in names if name.endswith(".x") and "_from_" not in name]
    things = [name for name in places if "." not in name and name not in ("ee", "goal") and f"{name}.z" in names]
    obj = max(map(positions, things), key=lambda rows: float(np.ptp(rows, axis=0).sum()), default=hand)
    goal = positions("goal")[-1] if "goal" in places else None
    return Paths(policy, hand, obj, goal, 1 / spec.fps, caption)
