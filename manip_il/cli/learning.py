"""`manip-il rl gail`, `airl`, `ppo`: reinforcement learning from demonstrations or a learnt reward."""

from __future__ import annotations

from dataclasses import MISSING, dataclass, field
from pathlib import Path
from typing import ClassVar

from manip_il.chapter.config import DiscriminatorConfig, LearningConfig, PPOConfig
from manip_il.cli.common_options import DatasetRoots, EngineOptions, worker_count
from manip_il.cli.options import Given, given
from manip_il.cli.outputs import ResumableOutput, output_folder
from manip_il.option import option


@dataclass(frozen=True)
class Learning(EngineOptions, ResumableOutput):
    """What `rl gail`, `rl airl` and `rl ppo` share: options, run, progress and report."""

    method: ClassVar[str]
    first: ClassVar[str] = "dataset.root init steps reward validation_episodes output_dir resume"
    init: Path | None = option(None, "a cloned mlp (a checkpoint or a run) to start from; by default a new policy")
    settings: Given = given(LearningConfig, prefix="")
    ppo: PPOConfig = field(default_factory=PPOConfig)
    workers: int | None = worker_count(1)


@dataclass(frozen=True, kw_only=True)
class GailOptions(Learning):
    """Imitate demonstrations by generative adversarial imitation learning (GAIL).

    A discriminator learns to tell the learner's steps from the expert's, and PPO learns to fool it. OUTPUT_DIR/best
    holds the policy with the highest validation success: an mlp like that of `manip-il train`.

    Example: manip-il rl gail --dataset.root=datasets/demos --init=runs/cloned
    --output_dir=runs/gail
    """

    method: ClassVar[str] = "gail"
    dataset: DatasetRoots
    discriminator: DiscriminatorConfig = field(default_factory=DiscriminatorConfig)
    output_dir: Path = output_folder("runs/gail")


@dataclass(frozen=True, kw_only=True)
class AirlOptions(GailOptions):
    """Imitate demonstrations by adversarial inverse reinforcement learning (AIRL).

    Like `manip-il rl gail`, with the discriminator exp f / (exp f + pi): f is a learnt reward, pi the policy's density.

    Example: manip-il rl airl --dataset.root=datasets/demos --init=runs/cloned
    --output_dir=runs/airl
    """

    method: ClassVar[str] = "airl"
    output_dir: Path = output_folder("runs/airl")


@dataclass(frozen=True, kw_only=True)
class PpoOptions(Learning):
    """Improve a cloned policy (--init) by PPO with a reward learnt from preferences.

    Episodes continue after success, because the reward scores every state. OUTPUT_DIR/best holds the policy with the
    highest validation success, which may be the initial one.

    Example: manip-il rl ppo --init=runs/cloned --reward=runs/reward --output_dir=runs/ppo
    """

    method: ClassVar[str] = "ppo"
    init: Path = option(MISSING, "the cloned mlp (a checkpoint or a run) to improve", exists="")
    reward: Path = option(MISSING, "the reward: a folder from manip-il reward fit", exists="")
    output_dir: Path = output_folder("runs/ppo")
