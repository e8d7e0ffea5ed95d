"""A checkpoint that acts: the one interface a rollout needs."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import MISSING, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import torch
from numpy.typing import NDArray
from safetensors import SafetensorError
from safetensors.torch import load_file

from manip_il.data.schema import ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.errors import ManipError, MismatchError, NotFiniteError, UsageError
from manip_il.learn.action_spaces import conversion
from manip_il.learn.checkpoint import META_FILE, CheckpointMeta, read_meta
from manip_il.learn.fit_config import EE_DELTA, JOINT_TARGET
from manip_il.learn.limits import Budget, threads
from manip_il.learn.losses import DISTRIBUTIONS
from manip_il.learn.network import MLPNetwork, Shape
from manip_il.learn.pretrained import CONFIG, WEIGHTS, Interface, interface_of, read_config
from manip_il.mdp import F32, F64, Images

if TYPE_CHECKING:  # it imports LeRobot, which takes seconds
    from manip_il.learn.lerobot_policy import EpisodePolicy

Batch = dict[str, torch.Tensor]
LIKELIHOODS = ("mixture", "categorical")  # losses whose spread depends on the state
NO_LIKELIHOOD = (
    "query=likelihood needs a policy with a likelihood: --policy.type=mlp with "
    f"--policy.loss={' or '.join(LIKELIHOODS)}"
)


class LearnedPolicy:
    """Actions from a LeRobot checkpoint, for many episodes at once.

    meta: what the policy was trained for, None for a checkpoint of lerobot-train. interface: what it sees and gives.
    """

    def __init__(self, policy: EpisodePolicy | _Perceptron, interface: Interface, meta: CheckpointMeta | None = None):
        self.interface, self.meta = interface, meta
        self._policy = policy

    @classmethod
    def load(cls, path: Path, device: str = "cpu", task: str = "", *, trust: bool = False) -> LearnedPolicy:
        """Load any LeRobot `pretrained_model` folder, from JSON and safetensors alone unless `trust`.

        The mlp is read without LeRobot, whose import takes seconds; another policy by LeRobot's own factory. task:
        text for a policy that reads language, where `instruct` gives no other. trust: load models and code that the
        checkpoint names, too. Raises `ManipError` for a folder that is not whole, that holds a pickle, whose files do
        not match, or that names code to import or, without `trust`, models to load; `UnknownName` for a type of policy
        that is not known.
        """
        path = Path(path)
        if device.startswith("cuda") and not torch.cuda.is_available():
            raise UsageError(f"device is {device!r}, but torch sees no graphics card here; expected 'cpu'")
        config = read_config(path)
        interface, meta = interface_of(config, path), read_meta(path)
        if meta is not None and meta.action_space not in (None, interface.space):
            raise MismatchError("action space", str(path / META_FILE), meta.action_space, CONFIG, interface.space)
        if config["type"] == "mlp":
            return cls(_Perceptron(path, config, interface, device), interface, meta)
        from manip_il.learn.lerobot_policy import load_policy

        return cls(load_policy(path, config, device, task, trust), interface, meta)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Cameras among its inputs."""
        return tuple(self.interface.pictures)

    @property
    def module(self) -> torch.nn.Module:
        """The network: an `MLPNetwork` of the mlp, LeRobot's policy of any other type."""
        return self._policy.module

    @torch.inference_mode()
    def act(
        self, states: F32, environment_states: F32, images: Images | None = None, episodes: Sequence[int] | None = None
    ) -> F64:
        """Return absolute actions, (B, n): joint targets [rad], gripper command [m].

        states: (B, n); environment_states: (B, k); images: camera -> (B, H, W, 3). episodes: a number for each row,
        its seed: what the policy remembers of an episode, and what it draws in it, belong to that number; by default
        the row's place. An episode that is left out has ended. An action is the same bits whatever the other rows.
        Raises `NotFiniteError` naming the row, `MismatchError` for numbers or pictures that are not the policy's.
        """
        rows = len(states)
        episodes = range(rows) if episodes is None else episodes
        if len(episodes) != rows:
            raise MismatchError("rows", "the states", rows, "the episodes", len(episodes))
        batch = self._numbers(states, environment_states) | self._pictures(rows, images or {})
        if not rows:
            return np.empty((0, self.interface.action))
        with threads(1):
            actions = self._policy.select(batch, episodes).cpu().numpy().astype(np.float64)
        if actions.shape != (expected := (rows, self.interface.action)):
            raise MismatchError("shape of the actions", CONFIG, expected, "the policy", actions.shape)
        _require_finite_rows("the policy's action", actions)
        return actions

    def reset(self, episodes: Iterable[int]) -> None:
        """Forget the past of episodes that begin."""
        self._policy.forget(episodes)

    def instruct(self, instructions: Mapping[int, str]) -> None:
        """Take the texts of episodes that begin, by their numbers: for a policy that reads language."""
        self._policy.instruct(instructions)

    @torch.inference_mode()
    def sample(self, states: F32, environment_states: F32, images: Images, rngs: Sequence[np.random.Generator]) -> F64:
        """Draw absolute actions, (B, n), each row's from its own generator, whatever the other rows are.

        Not clipped to the range of the data, as `act` is. Raises `UsageError` for a policy whose loss learns no spread,
        and what `act` raises.
        """
        perceptron = self._with_spread()
        if len(rngs) != len(states):
            raise MismatchError("rows", "the states", len(states), "the generators", len(rngs))
        batch = self._numbers(states, environment_states)
        if not len(states):
            return np.empty((0, self.interface.action))
        with threads(1):
            actions = perceptron.sample(batch, rngs).numpy().astype(np.float64)
        _require_finite_rows("the policy's sample", actions)
        return actions

    @torch.inference_mode()
    def log_prob(self, states: F32, environment_states: F32, images: Images, actions: F64) -> F64:
        """Return how likely the policy finds absolute actions (B, n), (B,): nats, in normalised units.

        Raises `UsageError` for a policy whose loss learns no spread.
        """
        perceptron = self._with_spread()
        batch = self._numbers(states, environment_states)
        with threads(1):
            return perceptron.log_prob(batch, torch.from_numpy(actions)).numpy().astype(np.float64)

    def require_likelihood(self) -> None:
        """Raise `UsageError` unless the policy tells how likely it finds an action, state by state."""
        if not isinstance(self._policy, _Perceptron) or self._policy.module.loss not in LIKELIHOODS:
            raise UsageError(NO_LIKELIHOOD)

    def _with_spread(self) -> _Perceptron:
        """The mlp; `UsageError` for any other policy, and for an mlp whose loss learns no spread."""
        if not isinstance(self._policy, _Perceptron):
            raise UsageError(
                f"a policy of type {self.interface.type!r} has no distribution of actions here; expected an mlp with "
                f"loss {', '.join(DISTRIBUTIONS)}"
            )
        self._policy.module.distribution()
        return self._policy

    def _numbers(self, states: F32, environment_states: F32) -> Batch:
        batch = {}
        for key, values in ((STATE, states), (ENVIRONMENT_STATE, environment_states)):
            if key not in self.interface.numbers:
                continue
            values = np.ascontiguousarray(values, dtype=np.float32)
            expected = (len(states), self.interface.numbers[key])
            if values.shape != expected:
                raise MismatchError(f"shape of {key}", "the policy", expected, "the caller", values.shape)
            _require_finite_rows(key, values)
            batch[key] = torch.from_numpy(values)
        return batch

    def _pictures(self, rows: int, images: Images) -> Batch:
        """Pictures as LeRobot's evaluation feeds them: float32 (B, 3, H, W), from 0 to 1."""
        if missing := set(self.cameras) - set(images):
            what = f"cameras ({', '.join(sorted(missing))})"
            raise MismatchError(what, "the policy", sorted(self.cameras), "the caller", sorted(images))
        batch = {}
        for camera, size in self.interface.pictures.items():
            expected = (rows, *size, 3)
            if (given := images[camera].shape) != expected:
                raise MismatchError(f"shape of the pictures of {camera}", "the policy", expected, "the caller", given)
            picture = torch.from_numpy(np.ascontiguousarray(images[camera])).permute(0, 3, 1, 2)
            batch[IMAGES + camera] = picture.contiguous().to(torch.float32) / 255
        return batch


class _Perceptron:
    """The mlp: no memory, and one call for all rows, whose actions do not depend on each other."""

    def __init__(self, path: Path, config: dict[str, Any], interface: Interface, device: str):
        self._device = device
        self._keys = [key for key in (STATE, ENVIRONMENT_STATE) if key in interface.numbers]
        shape = _shape(config, path / CONFIG)
        try:
            with Budget(path / WEIGHTS):
                self.module = MLPNetwork(sum(interface.numbers[key] for key in self._keys), interface.action, shape)
                weights = load_file(path / WEIGHTS)
            self.module.load_state_dict({name.removeprefix("model."): tensor for name, tensor in weights.items()})
        except (RuntimeError, SafetensorError) as error:
            line = " ".join(str(error).split())
            raise ManipError(f"{path}: weights and {CONFIG} do not match: {line}") from error
        except ManipError as error:
            raise ManipError(f"{path}: {error}") from error
        self.module.to(device).eval()
        # every other space is the network's own
        self._conversion = conversion(interface.space if interface.space == EE_DELTA else JOINT_TARGET, interface.robot)

    def select(self, batch: Batch, episodes: Sequence[int]) -> torch.Tensor:
        """Return one action a row (B, n).

        The mlp's processors are the identity (see MLPConfig), but for the conversion of an action space.
        """
        return self._decoded(self.module.act(self._inputs(batch)), batch)

    def sample(self, batch: Batch, rngs: Sequence[np.random.Generator]) -> torch.Tensor:
        """Return absolute actions (B, n), each row's from its own generator."""
        head = self.module.distribution()
        draws = torch.from_numpy(np.stack([head.draw(rng) for rng in rngs]))
        return self._decoded(self.module.sample(self._inputs(batch), draws.to(self._device)), batch).cpu()

    def log_prob(self, batch: Batch, actions: torch.Tensor) -> torch.Tensor:
        """Return the log-density of absolute actions (B, n) [nats], (B,)."""
        targets = self._conversion.encode(actions.to(torch.float32).numpy(), batch[STATE].numpy())
        return self.module.log_prob(self._inputs(batch), torch.from_numpy(targets).to(self._device)).cpu()

    def forget(self, episodes: Iterable[int]) -> None:
        """Forget nothing: the mlp has no memory."""

    def _decoded(self, targets: torch.Tensor, batch: Batch) -> torch.Tensor:
        if self._conversion.space == JOINT_TARGET:
            return targets
        return torch.from_numpy(self._conversion.decode(targets.cpu().numpy(), batch[STATE].numpy()))

    def instruct(self, instructions: Mapping[int, str]) -> None:
        """Read nothing: the mlp looks at numbers alone."""

    def _inputs(self, batch: Batch) -> torch.Tensor:
        return torch.cat([batch[key] for key in self._keys], dim=1).to(self._device)


def _shape(config: Mapping[str, Any], path: Path) -> Shape:
    """The network's shape in an mlp's `config.json`."""
    try:
        needed = [one.name for one in fields(Shape) if one.default is MISSING or one.name in config]
        return Shape(**{name: config[name] for name in needed})
    except KeyError as error:
        raise ManipError(f"{path} has no {error.args[0]}; it is not an mlp's") from error
    except ManipError as error:
        raise ManipError(f"{path}: {error}") from error


def _require_finite_rows(what: str, values: NDArray[Any]) -> None:
    finite = np.isfinite(values)
    if not finite.all():
        row = int(np.flatnonzero(~finite.all(axis=1))[0])
        raise NotFiniteError(f"{what} in row {row} is {values[row]}: not finite")
