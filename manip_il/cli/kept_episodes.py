"""Episodes of an evaluation on disk as they end, so that one that was stopped goes on where it was."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from manip_il.cli.folders import append_jsonl, read_jsonl
from manip_il.errors import ManipError, MismatchError

if TYPE_CHECKING:
    from manip_il.engine.jobs import RolloutJob
    from manip_il.evaluation.results import EpisodeResult

FILE_NAME = "episodes.jsonl"


@dataclass(frozen=True)
class KeptEpisodes:
    """`episodes.jsonl`: first what all episodes have in common, then a line for each."""

    path: Path

    @classmethod
    def open(cls, folder: Path, job: RolloutJob, suite: str, name: str) -> KeptEpisodes:
        """Return the file in `folder`, begun where there is none.

        Raises `MismatchError` where its episodes are those of another policy, environment or version of this program.
        """
        kept, common = cls(folder / FILE_NAME), _common(job, suite)
        lines = read_jsonl(kept.path)
        if not lines:
            append_jsonl(kept.path, common)
            return kept
        for key, now in common.items():
            before = lines[0].get(key)
            if before != now:
                what = f"{key} ({name} was started with another; --overwrite=true starts over)"
                raise MismatchError(what, "then", before, "now", now)
        return kept

    def add(self, result: EpisodeResult) -> None:
        """Put one away, at once."""
        append_jsonl(self.path, result.to_json())

    def results(self, seeds: Collection[int]) -> dict[int, EpisodeResult]:
        """What is there of these seeds. Raises `ManipError` for a line that is not an episode."""
        from manip_il.evaluation.results import EpisodeResult

        found: dict[int, EpisodeResult] = {}
        for line in read_jsonl(self.path)[1:]:
            try:
                result = EpisodeResult.from_json(line)
            except (KeyError, ManipError) as error:
                why = f"{error} is missing" if isinstance(error, KeyError) else error
                raise ManipError(
                    f"{self.path}: a line that is not an episode ({why}); start again with --overwrite=true"
                ) from error
            if result.seed in seeds:
                found[result.seed] = result
        return found


def _common(job: RolloutJob, suite: str) -> dict[str, Any]:
    from manip_il.engine.environments import env_fingerprint, policy_sha256
    from manip_il.engine.jobs import observed_cameras
    from manip_il.evaluation.results import EvalSettings

    return {
        "policy_sha256": policy_sha256(job.policy) if job.policy is not None else job.driver,
        "fingerprint": env_fingerprint(job.env, observed_cameras(job)),
        "settings": EvalSettings.of(job, suite).to_json(),
    }
