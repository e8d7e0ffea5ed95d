"""What the program needs of a learner, whatever network it is."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

F32, F64 = NDArray[np.float32], NDArray[np.float64]
Images = Mapping[str, NDArray[np.uint8]]  # camera -> (B, H, W, 3)


class Policy(Protocol):
    """Actions from joint states (B, n), environment states (B, k) and pictures, for many episodes at once."""

    @property
    def cameras(self) -> Sequence[str]:
        """Whose pictures it looks at."""
        ...

    def act(self, states: F32, environment_states: F32, images: Images, episodes: Sequence[int]) -> F64:
        """Return one absolute action a row, (B, n). episodes: whose row each is."""
        ...

    def reset(self, episodes: Sequence[int]) -> None:
        """Forget the past of episodes that begin."""
        ...

    def sample(self, states: F32, environment_states: F32, images: Images, rngs: Sequence[np.random.Generator]) -> F64:
        """Draw one absolute action a row, (B, n), each from its own generator; `UsageError` without a distribution."""
        ...

    def log_prob(self, states: F32, environment_states: F32, images: Images, actions: F64) -> F64:
        """Return how likely each row's action (B, n) is [nats], (B,); `UsageError` without a distribution."""
        ...
