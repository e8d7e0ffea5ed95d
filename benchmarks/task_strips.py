"""Film strips of all tasks, solved by the expert, for `docs/tasks.md`.

Usage: MUJOCO_GL=egl python benchmarks/task_strips.py [TASK ...]; writes docs/tasks/TASK.jpg.
"""

import sys
from pathlib import Path

import numpy as np
from PIL import Image

from manip_il import Expert
from manip_il.seeding import stream_seeds
from manip_il.sim.config import FILM
from manip_il.sim.render import Picture
from manip_il.tasks.table import TASKS
from manip_il.worlds.ladder.world import make_env

FRAMES = 6  # frames per strip
# part of the front camera's picture with the task in it [pixels]
CROP = (slice(90, 450), slice(130, 610))
EPISODES = {"carry": 1}  # index of the episode shown, of the first four; for other tasks the last
HEIGHT = 180  # height of a strip [pixels]
DOCS = Path(__file__).parent.parent / "docs" / "tasks"


def film(task: str) -> list[Picture]:
    """Return pictures of every other control step of one solved episode, and of its end."""
    env = make_env("panda", task, look=FILM, render_mode="rgb_array")
    expert, pictures = Expert(env.scene), []
    env.start(stream_seeds("training", 4)[EPISODES.get(task, 3)])
    for step in range(env.config.horizon):
        picture = env.render() if step % 2 == 0 else None
        pictures += [picture] if picture is not None else []
        env.advance(expert.label(env.get_state()).action)
        if env.solved:
            break
    last = env.render()
    return [*pictures, last] if last is not None else pictures


def strip(pictures: list[Picture]) -> Image.Image:
    """Return evenly spaced pictures from beginning to end, side by side."""
    chosen = np.linspace(0, len(pictures) - 1, FRAMES).round().astype(int)
    whole = Image.fromarray(np.hstack([pictures[i][CROP] for i in chosen]))
    return whole.resize((whole.width * HEIGHT // whole.height, HEIGHT), Image.Resampling.LANCZOS)


def main() -> None:
    DOCS.mkdir(exist_ok=True)
    for task in sys.argv[1:] or TASKS:
        path = DOCS / f"{task}.jpg"
        strip(film(task)).save(path, quality=85)
        print(f"{path}: {path.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
