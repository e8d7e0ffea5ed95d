"""The page that asks people to compare two films side by side: one self-contained HTML file."""

import base64
import hashlib
import math
from collections.abc import Callable
from importlib.resources import files
from pathlib import Path
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined
from markupsafe import Markup

from manip_il.chapter.preferences.pairs import PREFERENCES, VERSION, Clips, Pairs
from manip_il.collect.edits import open_source
from manip_il.data import schema
from manip_il.data.dataset import joined_columns
from manip_il.evaluation.film import film_states

SIDE = 240  # edge of a film [pixels]
MOST_FPS = 10  # films play in real time; rendering a picture takes tens of milliseconds


Films = list[list[bytes]]  # MP4s of each pair, left and right


def render_films(
    clips: Clips, robot: Path | None = None, on_pair: Callable[[], None] = lambda: None
) -> Films:
    """Return films of the left and right clip of every pair.

    Args:
        clips: The pairs, with datasets that hold the simulator's states.
        robot: YAML of the sources' robot, if it is not a built-in one.
        on_pair: Called after every pair.

    Returns:
        MP4s that play in real time, in the order of the pairs.

    Raises:
        RenderError: If there is no off-screen OpenGL.
        ManipError: If the states of a source cannot be rendered.
    """
    opened = [open_source(root, robot) for root in clips.roots]
    states = joined_columns([one.dataset for one in opened], [schema.SIM_STATE])[schema.SIM_STATE]
    every = math.ceil(clips.pairs.control_hz / MOST_FPS)
    found: Films = []
    for pair, rows in zip(clips.pairs.pairs, clips.rows, strict=True):
        found.append(
            [
                film_states(opened[clip.source].env, states[own], every, (SIDE, SIDE))
                for clip, own in zip(pair, rows, strict=True)
            ]
        )
        on_pair()
    return found


def render_page(pairs: Pairs, instruction: str, films: Films) -> str:
    """Return the page that asks people to compare the clips of every pair.

    Args:
        pairs: The pairs.
        instruction: The task in words.
        films: Films of the pairs, see `render_films`.

    Returns:
        One string of HTML, which needs no other file.
    """
    script = (files("manip_il.chapter.preferences") / "templates" / "ask.js").read_text(
        encoding="utf-8"
    )
    data: dict[str, Any] = {
        "format": PREFERENCES,
        "version": VERSION,
        "pairs": pairs.sha256,
        "films": [[base64.b64encode(film).decode("ascii") for film in pair] for pair in films],
    }
    environment = Environment(
        loader=PackageLoader("manip_il.chapter.preferences"),
        autoescape=True,
        undefined=StrictUndefined,
    )
    return environment.get_template("ask.html.j2").render(
        title=f"{pairs.robot} {pairs.task}",
        instruction=instruction,
        count=len(pairs),
        data=data,
        script=Markup(script),
        script_sha256=base64.b64encode(hashlib.sha256(script.encode()).digest()).decode("ascii"),
    )
