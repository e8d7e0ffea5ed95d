"""What a published model would miss in a dataset, if it is fine-tuned on it with LeRobot."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from manip_il.bridges.doctor.files import Finding, warning
from manip_il.data.dataset import Dataset
from manip_il.data.lerobot_layout import INFO, STATS, TASK_INDEX, TASKS
from manip_il.data.schema import ACTION, STATE

_MOST = 32  # numbers in state and action
_EPISODES = 50  # episodes to begin with, and of each variation: "25 were not enough"
_EACH = 10
_LANGUAGE = "language_persistent"


@dataclass(frozen=True)
class Model:
    """What a model was trained on.

    Attributes:
        views: Names of the cameras of its published checkpoint.
        pixels: Height and width to which it scales pictures [pixels].
        fps: Control rate [Hz].
        quantiles: Whether it normalises by quantiles of state and action.
        source: Where this is published.
    """

    views: tuple[str, ...]
    pixels: int
    fps: int
    quantiles: bool
    source: str


MODELS = {
    "smolvla": Model(
        ("camera1", "camera2", "camera3"), 512, 30, False, "huggingface.co/docs/lerobot/smolvla"
    ),
    "pi05": Model(
        ("base_0_rgb", "left_wrist_0_rgb", "right_wrist_0_rgb"),
        224,
        30,
        True,
        "huggingface.co/docs/lerobot/pi05",
    ),
    "groot": Model((), 256, 30, False, "huggingface.co/docs/lerobot/groot"),
}


def missing(dataset: Dataset, name: str) -> Iterator[Finding]:
    """Yield what a model would miss in a dataset.

    Args:
        dataset: The dataset.
        name: A name in `MODELS`.
    """
    model, info = MODELS[name], dataset.info
    views = [key.rpartition(".")[2] for key in dataset.cameras]
    if len(views) < 2:
        yield warning(
            INFO,
            f"{name} learns from a fixed and a wrist camera; there are {len(views)} cameras",
            "manip-il data render DATASET --cameras=front,wrist",
        )
    names = [
        f'"observation.images.{old}": "observation.images.{new}"'
        for old, new in zip(views, model.views, strict=False)
        if old != new
    ]
    if names:
        yield warning(
            INFO,
            f"the published {name} calls its cameras {', '.join(model.views)}",
            f"lerobot-train --rename_map='{{{', '.join(names)}}}'",
        )
    small = [key for key in dataset.cameras if min(info.features[key].picture_size) < model.pixels]
    if small:
        size = "x".join(map(str, info.features[small[0]].picture_size))
        yield warning(
            INFO,
            f"{name} reads {model.pixels}x{model.pixels} pixels; pictures are {size}",
            f"manip-il data render DATASET --image.height={model.pixels}"
            f" --image.width={model.pixels}",
        )
    if info.fps < model.fps / 2:
        yield warning(
            INFO,
            f"{name} learnt from {model.fps} frames a second; here are {info.fps:g}",
            f"manip-il record --env.control_hz={model.fps}",
        )
    for key in (STATE, ACTION):
        if (size := info.features[key].size) > _MOST:
            yield warning(INFO, f"{key} has {size} numbers, and {name} reads {_MOST}")
        if model.quantiles and not {"q01", "q99"} <= dataset.statistics.get(key, {}).keys():
            yield warning(
                STATS, f"{key} has no quantiles, by which {name} normalises", "manip-il data repair"
            )
    numbers = dataset.columns([TASK_INDEX])[TASK_INDEX].reshape(-1)
    told = Counter(dataset.texts(numbers[dataset.episodes.start]))
    few = [text for text, count in told.items() if count < _EACH]
    if len(dataset.episodes) < _EPISODES or few:
        yield warning(
            INFO,
            f"{len(dataset.episodes)} episodes, {min(told.values())} of the rarest task; {name}"
            f" needs about {_EPISODES}, and {_EACH} of each variation",
            f"manip-il record --dataset.num_episodes={_EPISODES * len(told)}",
        )
    if not all(told) or _LANGUAGE not in info.features:
        yield warning(
            TASKS,
            "no texts of subtasks and no other words for the task",
            "manip-il data annotate DATASET",
        )
