"""The options of a fit, by LeRobot's names.

Imports neither torch nor LeRobot, so that help is fast.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, NamedTuple

from manip_il.errors import UsageError
from manip_il.learn.names import CNN, MLP
from manip_il.option import check_bounds, option

if TYPE_CHECKING:  # `checkpoint` imports numpy
    from manip_il.learn.checkpoint import Checkpoint


class Defaults(NamedTuple):
    """Gradient steps, samples per batch, and steps between checkpoints."""

    steps: int
    batch_size: int
    save_freq: int


ActionSpace = Literal["joint_target", "joint_delta", "ee_delta"]
LEROBOT = Defaults(100_000, 8, 20_000)
# where these differ from LeRobot's
DEFAULTS = {MLP: Defaults(3_000, 512, 1_000), CNN: Defaults(15_000, 32, 1_000)}


def _by_default(name: str) -> str:
    """Return the end of a help text: the default of `name` for each policy type."""
    own = ", ".join(f"{getattr(numbers, name):,} for {kind}" for kind, numbers in DEFAULTS.items())
    return f"by default {own}, else {getattr(LEROBOT, name):,}"


@dataclass(frozen=True)
class FitConfig:
    """Options of a fit; None means the default of the policy's type.

    Attributes:
        policy: `type` or `path` (of a checkpoint or a run), and the options of that policy
            (`loss`, `width`, `chunk_size`, ...).
        action_space: See `manip_il.learn.action_spaces`; by default that of the initial checkpoint,
            if there is one.
        threads: With a second thread a fit is up to 1.8 times as fast if a core is free, and tens
            of times slower if none is.
        trust: Whether models that the policy or its checkpoint names may be loaded.
        seed: For weights and batches.
        init_from: A checkpoint with the initial weights.

    Raises:
        UsageError: A number is out of range, or options do not go together.
    """

    policy: Mapping[str, Any] = option(
        dict,
        "an option of the policy: type (mlp, cnn or one of LeRobot's), path (a policy to start"
        " from), or any option that --policy.type=TYPE --help lists",
    )
    action_space: ActionSpace | None = option(
        None,
        "what the policy learns to predict; by default joint_delta for mlp and cnn, else"
        " joint_target",
    )
    observation: Literal["state", "images", "both"] | None = option(
        None,
        "what the policy observes in addition to the joints; by default images for cnn, else state",
    )
    steps: int | None = option(
        None, f"gradient steps; {_by_default('steps')}", grows=True, at_least=1
    )
    batch_size: int | None = option(
        None, f"frames per step; {_by_default('batch_size')}", at_least=1
    )
    lr: float | None = option(
        None, "peak learning rate; by default the policy's own", at_least=1e-15
    )
    optimizer: Mapping[str, Any] = option(
        dict,
        "an option of an optimiser that replaces the policy's own: type (adamw, ...),"
        " weight_decay, ...",
    )
    scheduler: Mapping[str, Any] = option(
        dict, "an option of a learning-rate schedule that replaces the policy's own: type, ..."
    )
    eval_split: float = option(
        0.05,
        "share of the episodes held out for val_loss",
        flag="dataset.eval_split",
        at_least=0,
        at_most=0.99,
    )
    image_augment: bool | None = option(
        None, "random crops and colour jitter during training; by default on, except for cnn"
    )
    threads: int = option(
        1, "PyTorch threads; more than one helps only if cores are idle", free=True, at_least=1
    )
    save_freq: int | None = option(
        None, f"steps between checkpoints; {_by_default('save_freq')}", free=True, at_least=1
    )
    log_freq: int = option(200, "steps between metrics", free=True, at_least=1)
    tensorboard: bool = option(
        False, "write curves for TensorBoard to OUTPUT_DIR/tensorboard", free=True
    )
    wandb: Mapping[str, Any] = option(
        dict, "an option of Weights & Biases: enable, project, mode, ...", free=True
    )
    trust: bool = False
    seed: int = 0
    init_from: Path | None = None

    def __post_init__(self) -> None:
        check_bounds(self)
        if "path" in self.policy and "type" in self.policy:
            raise UsageError(
                "--policy.path and --policy.type exclude each other: a checkpoint has its own type;"
                " give one of them"
            )
        if self.kind == MLP and self.takes_images:
            raise UsageError(
                f"--observation={self.observes} needs a policy that takes images, unlike mlp; use"
                " --policy.type=cnn"
            )

    @cached_property
    def start(self) -> Checkpoint | None:
        """The checkpoint in `policy.path`.

        Raises:
            ManipError: The checkpoint cannot be read.
        """
        return _open(self.policy["path"]) if "path" in self.policy else None

    @cached_property
    def initial(self) -> Checkpoint | None:
        """The checkpoint with the initial weights, in `policy.path` or `init_from`.

        Raises what `start` raises.
        """
        return self.start if self.init_from is None else _open(self.init_from)

    @property
    def kind(self) -> str:
        """The type of the policy."""
        return self.start.kind if self.start else str(self.policy.get("type", MLP))

    @property
    def observes(self) -> str:
        """The requested member of `OBSERVATIONS`, else the checkpoint's, else images for cnn,
        else state.
        """
        return self.observation or (
            self.start.observation if self.start else "images" if self.kind == CNN else "state"
        )

    @property
    def takes_images(self) -> bool:
        """Whether pictures are among the policy's inputs."""
        return self.observes != "state"

    @property
    def defaults(self) -> Defaults:
        """Default numbers for this policy type."""
        return DEFAULTS.get(self.kind, LEROBOT)

    @property
    def augments(self) -> bool:
        """Whether pictures are randomly changed.

        By default not for cnn, as crops hide where things are.
        """
        return self.kind != CNN if self.image_augment is None else self.image_augment

    @property
    def total_steps(self) -> int:
        """Gradient steps."""
        return self.steps or self.defaults.steps


def _open(path: Path | str) -> Checkpoint:
    from manip_il.learn.checkpoint import Checkpoint  # which imports numpy

    return Checkpoint.of(path)
