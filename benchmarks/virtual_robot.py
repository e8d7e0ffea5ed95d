"""The virtual robot in use, for `README.md`: the output of `manip-il serve`, and what LeRobot's
recorder recorded.

Usage: MUJOCO_GL=egl python benchmarks/virtual_robot.py; writes docs/virtual_robot.png, in about a
minute.
"""

import re
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from lerobot.datasets import LeRobotDataset
from matplotlib.gridspec import GridSpec

OUTPUT = Path(__file__).parent.parent / "docs" / "virtual_robot.png"
HEIGHT, WIDTH = 144, 192  # size of a camera's picture [pixels]
MOMENTS = 3  # number of moments shown per episode
SHOWN = (
    r"(?:follower|leader): |Recording episode|Reset the env|Stop recording|Right arrow|.*ended; "
)
SAID = rf"^(?:INFO .*\d (?=[RS]))?((?:{SHOWN}).*)$"
COMMANDS = [
    "$ manip-il serve --task.type=lift --cameras=front,wrist -- \\",
    "    lerobot-record --robot.type=so101_follower \\",
    "        --robot.port=runs/serve/follower \\",
    "        --teleop.type=so101_leader --teleop.port=runs/serve/leader ...",
]


def record(folder: Path) -> tuple[list[str], LeRobotDataset]:
    """Record two episodes with LeRobot's recorder; return the shortened output and the dataset."""
    tools, arm = Path(sys.executable).parent, folder / "arm"
    shared = (
        f"type: zmq, server_address: 127.0.0.1, port: 5598, width: {WIDTH}, height: {HEIGHT},"
        " fps: 30"
    )
    cameras = ", ".join(f"{name}: {{{shared}, camera_name: {name}}}" for name in ("front", "wrist"))
    sizes = [
        f"--image.height={HEIGHT}",
        f"--image.width={WIDTH}",
        "--camera_port=5598",
        f"--output_dir={arm}",
    ]
    arms = [
        *("--robot.type=so101_follower", f"--robot.port={arm}/follower", "--robot.id=follower"),
        *("--teleop.type=so101_leader", f"--teleop.port={arm}/leader", "--teleop.id=leader"),
        *(
            f"--robot.calibration_dir={arm}",
            f"--teleop.calibration_dir={arm}",
            f"--robot.cameras={{{cameras}}}",
        ),
    ]
    data = [
        "--dataset.repo_id=local/lift",
        f"--dataset.root={folder}/data",
        "--dataset.single_task=Lift the cube",
    ]
    data += ["--dataset.num_episodes=2", "--dataset.push_to_hub=false", "--play_sounds=false"]
    serve = [tools / "manip-il", "serve", "--task.type=lift", "--cameras=front,wrist", *sizes, "--"]
    run = subprocess.run(
        [*serve, tools / "lerobot-record", *arms, *data],
        stdout=subprocess.PIPE,
        text=True,
        check=True,
    )
    printed = re.sub(r"\x1b\[[\d;]*m", "", run.stdout.replace("\r", "")).replace(
        str(arm), "runs/serve"
    )
    lines = [found.replace(f"{tools}/", "") for found in re.findall(SAID, printed, re.MULTILINE)]
    return lines, LeRobotDataset("local/lift", root=folder / "data")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        lines, dataset = record(Path(folder))
        # last frame of the first episode
        last = int(np.argmax(np.array(dataset.hf_dataset["episode_index"]) == 1)) - 1
        moments = np.linspace(0, last, MOMENTS).round().astype(int)
        frames: list[Any] = [dataset[int(moment)] for moment in moments]
    plt.rcParams["font.family"] = "DejaVu Sans Mono"
    figure = plt.figure(figsize=(11, 3.1), dpi=100, facecolor="#16181d")
    figure.text(
        0.01,
        0.95,
        "\n".join([*COMMANDS, *lines]),
        color="#d5dae3",
        size=8,
        va="top",
        linespacing=1.5,
    )
    grid = GridSpec(
        2, MOMENTS, figure, left=0.49, right=0.995, bottom=0.02, top=0.93, wspace=0.03, hspace=0.12
    )
    for row, camera in enumerate(("front", "wrist")):
        for column, frame in enumerate(frames):
            axes = figure.add_subplot(grid[row, column])
            axes.imshow(frame[f"observation.images.{camera}"].permute(1, 2, 0).numpy())
            axes.set_title(
                f"{camera}, {frame['timestamp']:.1f} s", color="#8b93a3", size=7, pad=2, loc="left"
            )
            axes.axis("off")
    figure.savefig(OUTPUT)
    print(f"{OUTPUT}: {OUTPUT.stat().st_size / 1000:.0f} kB")


if __name__ == "__main__":
    main()
