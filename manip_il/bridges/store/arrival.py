"""What arrives from a remote is counted while it comes: files against the remote's list, answers against a limit."""

from __future__ import annotations

from typing import Any, override

from fsspec.callbacks import Callback

from manip_il.bridges.store.errors import RemoteError


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
            raise RemoteError(f"it sends more than the {self.most:,} bytes that were expected; nothing was kept")

    def __call__(self, *given: Any, **options: Any) -> Arrival:
        """Return the bar, for huggingface_hub."""
        return self

    def update(self, count: float | None = 1) -> None:
        """Count more bytes."""
        self.relative_update(int(count or 0))
