"""The expert of two arms recovers: a film of both tasks, for `docs/aloha.md`, in which the object
is knocked away.

Usage: MUJOCO_GL=egl python benchmarks/two_arms.py; writes docs/two_arms.gif, in about two minutes.
"""

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw

from manip_il.worlds.aloha.environment import Aloha, AlohaEnv

OUTPUT = Path(__file__).parent.parent / "docs" / "two_arms.gif"
HEIGHT, WIDTH, CAMERA = 200, 320, "angle"
EVERY, HOLD = 3, 8  # control steps per frame; frames for which the last picture stays
HORIZON = 400
COLOURS = 48
SAID = 18  # control steps after a knock during which the caption names it


class Knock(NamedTuple):
    """An external force on an object, from the first control step in `phase` on. steps: control
    steps that it lasts.
    """

    task: str
    thing: str
    phase: str
    force: tuple[float, float, float]  # [N]
    seed: int
    steps: int = 6


KNOCKS = (
    Knock("AlohaTransferCube-v0", "box", "close, carry", (0.0, 0.0, -20.0), 3),
    Knock("AlohaInsertion-v0", "peg", "carry, align", (2.5, 1.5, -5.0), 3),
)


def film(knock: Knock) -> list[Image.Image]:
    """Return the frames of one episode, from its start until the task is solved."""
    world = Aloha(knock.task)
    env = AlohaEnv(world)
    env.start(knock.seed)
    body = world.model.body(knock.thing).id
    frames: list[Image.Image] = []
    left, caption, solved = knock.steps, 0, False
    for step in range(HORIZON):
        label = env.label()
        phase = world.phases[label.phase]
        pushed = left > 0 and (left < knock.steps or phase == knock.phase)
        left, caption = left - pushed, SAID if pushed else caption - 1
        world.data.xfrc_applied[body, :3] = knock.force if pushed else 0.0
        if step % EVERY == 0 or solved:
            frames.append(
                captioned(world.physics.render(HEIGHT, WIDTH, CAMERA), phase, caption > 0)
            )
        if solved:
            return frames
        solved = env.step(label.action).solved
    raise RuntimeError(f"{knock.task} was not solved within {HORIZON} steps")


def captioned(picture: NDArray[np.uint8], phase: str, pushed: bool) -> Image.Image:
    """Return a frame with the phases of both hands."""
    frame = Image.fromarray(picture)
    text = "knocked away" if pushed else phase
    ImageDraw.Draw(frame).text((6, 4), text, fill=(255, 90, 90) if pushed else (230, 230, 230))
    return frame


def main() -> None:
    films = [film(knock) for knock in KNOCKS]
    length = max(map(len, films)) + HOLD
    frames: list[Image.Image] = []
    for moment in range(length):
        frame = Image.new("RGB", (2 * WIDTH, HEIGHT))
        for place, one in enumerate(films):
            frame.paste(one[min(moment, len(one) - 1)], (place * WIDTH, 0))
        frames.append(frame.quantize(COLOURS))
    first, *rest = frames
    first.save(
        OUTPUT, save_all=True, append_images=rest, duration=EVERY * 20, loop=0, optimize=True
    )
    print(f"{OUTPUT}: {length} frames, {OUTPUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
