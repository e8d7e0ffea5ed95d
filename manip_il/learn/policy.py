"""A policy loaded from a checkpoint, with the interface that rollouts use."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il.data.lerobot_layout import EPISODE_INDEX
from manip_il.data.schema import ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import MismatchError, UsageError
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.checkpoint import CONFIG, Checkpoint, in_one_line
from manip_il.learn.names import EE_DELTA, JOINT_TARGET, MLP
from manip_il.learn.network import MLPNetwork, NetworkConfig, read_weights, require_device, threads
from manip_il.learn.texts import LENGTH, tokens
from manip_il.mdp import F32, F64, I64, Images, require_finite

if TYPE_CHECKING:  # `episode_policy` imports LeRobot, which takes seconds
    from manip_il.learn.episode_policy import EpisodePolicy

Batch = dict[str, torch.Tensor]


class LearnedPolicy:
    """Actions from a LeRobot checkpoint, for many episodes at once.

    Args:
        policy: The policy, loaded.
        checkpoint: Its inputs, outputs and origin.
    """

    def __init__(self, policy: EpisodePolicy | _Perceptron, checkpoint: Checkpoint):
        self.checkpoint, self._policy = checkpoint, policy

    @classmethod
    def load(
        cls,
        checkpoint: Checkpoint | Path,
        device: str = "cpu",
        task: str = "",
        *,
        trust: bool = False,
    ) -> LearnedPolicy:
        """Load any LeRobot checkpoint, only from JSON and safetensors unless `trust` is set.

        The mlp is loaded without LeRobot, whose import takes seconds; other policies by LeRobot's
        own factory.

        Args:
            checkpoint: The checkpoint, or the path of it or of a run.
            device: Torch's name for the device.
            task: Instruction for a policy that reads language, if `begin` gives no other.
            trust: Whether to load models and code that the checkpoint names.

        Raises:
            UsageError: The device is a GPU, but PyTorch finds none.
            UnknownName: The type of policy is unknown.
            ManipError: The folder is incomplete, its files do not match, or they name models to
                load and `trust` is not set.
        """
        require_device(device)
        opened = Checkpoint.of(checkpoint)
        if opened.kind == MLP:
            return cls(_Perceptron(opened, device, task), opened)
        from manip_il.learn.episode_policy import EpisodePolicy

        return cls(EpisodePolicy(opened, device, task, trust), opened)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras among the policy's inputs."""
        return tuple(self.checkpoint.pictures)

    @property
    def module(self) -> torch.nn.Module:
        """The network: an `MLPNetwork` for the mlp, a `PreTrainedPolicy` for any other type."""
        return self._policy.module

    @torch.inference_mode()
    def act(
        self,
        states: F32,
        environment_states: F32,
        images: Images | None = None,
        episodes: Sequence[int] | None = None,
    ) -> F64:
        """Return an absolute action for each row.

        An action is bit-identical whatever the other rows are.

        Args:
            states: Joint states (B, n).
            environment_states: Environment states (B, k).
            images: Pictures uint8 (B, H, W, 3) by camera.
            episodes: A number for each row, by default its index. The policy's memory of an episode
                and its random draws depend on that number. An episode that is not listed has ended.

        Returns:
            Actions (B, n), as in the training data: usually joint targets [rad] and a gripper
            command [m].

        Raises:
            NotFiniteError: An action is not finite; the message names the row.
            MismatchError: Pictures are missing or have another size.
        """
        if not len(states):
            return np.empty((0, self.checkpoint.action))
        numbers = {STATE: states, ENVIRONMENT_STATE: environment_states}
        batch = {
            key: torch.from_numpy(np.ascontiguousarray(values, dtype=np.float32))
            for key, values in numbers.items()
            if key in self.checkpoint.numbers
        }
        batch |= self._pictures(images or {})
        with threads(1):
            actions = self._policy.select(
                batch, range(len(states)) if episodes is None else episodes
            )
        found = actions.cpu().numpy().astype(np.float64)
        require_finite("the policy's action", found)
        return found

    def begin(self, instructions: Mapping[int, str]) -> None:
        """Reset the memory of episodes that begin.

        Args:
            instructions: For each episode's number, the text for a policy that reads language; ""
                means the `task` given to `load`.
        """
        self._policy.begin(instructions)

    def _pictures(self, images: Images) -> Batch:
        """Return pictures as in LeRobot's evaluation: float32 (B, 3, H, W), from 0 to 1."""
        batch = {}
        for camera, size in self.checkpoint.pictures.items():
            picture = images.get(camera, np.empty((0, 0, 0, 3), np.uint8))
            if picture.shape[1:3] != size:
                what = f"size of the pictures of {camera}"
                raise MismatchError(what, "the policy", size, "the caller", picture.shape[1:3])
            levels = torch.from_numpy(np.ascontiguousarray(picture)).permute(0, 3, 1, 2)
            batch[IMAGES + camera] = levels.contiguous().to(torch.float32) / 255
        return batch


def actions_along(
    policy: LearnedPolicy, table: Mapping[str, NDArray[Any]]
) -> Iterator[tuple[I64, F64]]:
    """Yield a policy's actions for each time step of whole recorded episodes.

    Args:
        policy: The policy, which must take no pictures.
        table: The columns `observation.state` (N, n), `observation.environment_state` (N, k) and
            `episode_index` (N,) or (N, 1), ascending.

    Yields:
        For each time step, the row numbers (B,) of its frames in the table, and the actions (B, n).
    """
    episodes = table[EPISODE_INDEX].reshape(-1)
    _, lengths = np.unique(episodes, return_counts=True)
    steps = np.concatenate([*map(np.arange, lengths)])
    for step in range(lengths.max()):  # in order, for policies with a memory
        rows = np.flatnonzero(steps == step)
        yield (
            rows,
            policy.act(
                table[STATE][rows], table[ENVIRONMENT_STATE][rows], {}, episodes[rows].tolist()
            ),
        )


class _Perceptron:
    """The mlp: no memory except of texts, and one call for all rows, whose actions are
    independent of each other.
    """

    def __init__(self, checkpoint: Checkpoint, device: str, task: str):
        self._device = device
        self._keys = [key for key in (STATE, ENVIRONMENT_STATE) if key in checkpoint.numbers]
        width = sum(checkpoint.numbers[key] for key in self._keys)
        config = NetworkConfig.of(checkpoint.config)
        width += LENGTH if config.reads_text else 0
        self._reads, self._task = bool(config.reads_text), task
        self._texts: dict[int, str] = {}
        with in_one_line(f"{checkpoint.path}: weights and {CONFIG} do not match"):
            self.module = MLPNetwork(width, checkpoint.action, config)
            self.module.load_state_dict(read_weights(checkpoint.path))
        self.module.to(device).eval()
        # the network converts joint_delta
        space = checkpoint.space if checkpoint.space == EE_DELTA else JOINT_TARGET
        self._decode = Conversion(space, checkpoint.robot).decode

    def select(self, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        """Return one action per row, (B, n).

        The mlp's processors are the identity (see MLPConfig), except for the conversion of an
        action space.
        """
        parts = [batch[key] for key in self._keys]
        if self._reads:
            self._texts = {one: self._texts.get(one, "") for one in episodes}
            texts = [self._texts[one] or self._task for one in episodes]
            if not all(texts):
                raise UsageError("the policy reads the task's text, which is not given here")
            parts.append(tokens(texts))
        inputs = torch.cat(parts, dim=1).to(self._device)
        targets = self.module.act(inputs).cpu().numpy()
        return torch.from_numpy(self._decode(targets, batch[STATE].numpy()))

    def begin(self, instructions: Mapping[int, str]) -> None:
        """Keep the texts of episodes that begin; there is no other memory."""
        self._texts |= instructions
