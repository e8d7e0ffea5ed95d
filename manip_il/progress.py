"""What a long piece of work reports while it runs."""

from typing import Any


class Progress:
    """The events of a long piece of work; this class ignores them all.

    An exception from a method ends the work; what is finished stays on disk.
    """

    def started(self) -> None:
        """All inputs have been checked, and nothing has been written yet."""

    def start(self, description: str, total: int | None) -> None:
        """A stage of `total` episodes or steps begins; None if their number is unknown."""

    def episode(self, episode: Any) -> None:
        """An `Episode`, or its `EpisodeResult`, is on disk."""

    def step(self, n: int = 1) -> None:
        """`n` steps of the stage are done."""

    def log(self, record: dict[str, Any]) -> None:
        """A step of a fit is done.

        Args:
            record: `step` and metrics, or {} if there are none.
        """

    def finished(self, result: Any) -> None:
        """A round or an iteration is done; `result` is its `Result`."""

    def close(self) -> None:
        """The stage is over."""
