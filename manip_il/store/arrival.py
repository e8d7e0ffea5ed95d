"""What arrives from a remote is counted while it comes, and may not be larger than the remote's list says."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, override

from fsspec.callbacks import Callback, TqdmCallback

from manip_il.store.errors import RemoteError


class Arrival(Callback):
    """Counts the bytes of one file. Raises `RemoteError` as soon as they are more than `most`.

    fsspec updates it as a callback. huggingface_hub calls it for a new progress bar, and updates that.
    """

    def __init__(self, most: int):
        super().__init__()
        self.most = most

    @override
    def call(self, *hook: Any, **given: Any) -> None:
        """Raise `RemoteError` if there are too many bytes."""
        if self.value > self.most:
            raise RemoteError(f"it sends more than the {self.most:,} bytes that its list says; nothing was kept")

    def __call__(self, *given: Any, **options: Any) -> Arrival:
        """Return the bar, for huggingface_hub."""
        return self

    def update(self, count: float | None = 1) -> None:
        """Count more bytes."""
        self.relative_update(int(count or 0))


class Arrivals(TqdmCallback):
    """A progress bar of files, each with its own `Arrival`. sizes: of each file [bytes], by its path on the remote."""

    def __init__(self, sizes: Mapping[str, int], bar: dict[str, Any]):
        super().__init__(bar)
        self._sizes = sizes

    @override
    def branched(self, path_1: Any, path_2: Any, **kwargs: Any) -> Arrival:
        """Return the callback of one file."""
        return Arrival(self._sizes[path_1])
