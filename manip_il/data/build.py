"""Journals to a LeRobot dataset: one by one while they are recorded, or all at once, with the same bytes."""

from __future__ import annotations

import dataclasses
import itertools
import json
import logging
import re
from collections.abc import Iterator, Mapping
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data.atomic import write_file
from manip_il.data.episodes import count_labels, first_labels, parts
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.journal import Header, list_episodes, read_journal
from manip_il.data.lerobot_io import DatasetInfo, DatasetWriter, VideoConfig, new_dataset
from manip_il.data.schema import RobotTaskSpec
from manip_il.errors import ManipError, MismatchError, NothingToLearnError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
RECORDING = "recording.json"
_LARGEST = 16 * 1024 * 1024  # of a recording.json [bytes]


@dataclass(frozen=True)
class Recording:
    """What a folder of journals becomes: its `recording.json`.

    A rollout becomes as many episodes as it has parts (see `parts`). only_successes: failed ones are left out.
    only_labelled: those without a sound label are. episodes: at most so many, the first in seed order; None: all.
    labels: at most so many sound ones; what comes after the last has `label_valid` 0, episodes beyond it are left out.
    provenance: who drove, for the dataset's own. video: how pictures are compressed, as `VideoConfig` has it.
    Raises `ManipError` naming what is wrong.
    """

    repo_id: str
    only_successes: bool = False
    episodes: int | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    video: dict[str, Any] = field(default_factory=dict)
    only_labelled: bool = False
    labels: int | None = None

    def __post_init__(self) -> None:
        checks.repo_id("repo_id", self.repo_id)
        for what in ("only_successes", "only_labelled"):
            checks.truth(what, getattr(self, what))
        for what in ("episodes", "labels"):
            if getattr(self, what) is not None:
                checks.whole(what, getattr(self, what), 0, checks.LARGEST_SEED)
        checks.mapping("provenance", self.provenance)
        VideoConfig.from_json(self.video)

    def open(
        self, root: Path, spec: RobotTaskSpec, fingerprint: Mapping[str, Any], *, replace: bool = False
    ) -> AbstractContextManager[DatasetWriter]:
        """Return the dataset's writer; raises what `new_dataset` raises."""
        video = VideoConfig.from_json(self.video)
        return new_dataset(root, spec, repo_id=self.repo_id, fingerprint=fingerprint, video=video, replace=replace)

    def write(self, journals: Path) -> None:
        """Write it beside the episodes."""
        journals.mkdir(parents=True, exist_ok=True)
        write_file(journals / RECORDING, (json.dumps(asdict(self), indent=1) + "\n").encode())

    @classmethod
    def read(cls, journals: Path) -> Recording:
        """Return the folder's own; where it has none, one that takes every episode."""
        path = journals / RECORDING
        if not path.is_file():
            return cls(local_id(journals.absolute().name.removesuffix(".journals") or "journals"))
        data = checks.read_json(path, "what a recording's journals become", _LARGEST)
        known = {one.name: data[one.name] for one in fields(cls) if one.name in data}
        if "repo_id" not in known:
            raise ManipError(f"{path} lacks repo_id; expected what `manip-il record` writes")
        try:
            return cls(**known)
        except ManipError as error:
            raise ManipError(f"{path}: {error}") from error


def local_id(folder: str) -> str:
    """Return the repository's id, `local/NAME`, of a dataset in a folder of this name, whatever characters it has."""
    name = re.sub(r"\.{2,}", ".", re.sub(r"[^A-Za-z0-9_.\-]+", "_", folder)).lstrip(".")
    return f"local/{name[: checks.LONGEST_NAME] or 'dataset'}"


@dataclass(frozen=True)
class BuildResult:
    """A built dataset. failed: episodes left out as they failed. damaged: what is wrong with each unreadable file."""

    info: DatasetInfo
    failed: int
    damaged: tuple[str, ...]


class Builder:
    """Feeds journals, given in seed order, to a dataset's writer; the result depends on the journals alone."""

    def __init__(self, writer: DatasetWriter, recording: Recording):
        self._writer, self._recording = writer, recording
        self._first: Header | None = None
        self._seeds: list[int] = []  # first and last
        self._rollouts = 0
        self.count = self.failed = self.labels = 0  # episodes taken and left out as they failed; sound labels

    @property
    def is_full(self) -> bool:
        """Whether every asked episode or label is in."""
        episodes, labels = self._recording.episodes, self._recording.labels
        return (episodes is not None and self.count >= episodes) or (labels is not None and self.labels >= labels)

    def add(self, header: Header, episode: Episode) -> None:
        """Take an episode and what its journal says; `MismatchError` where that is about something else than before."""
        self._first = self._first or header
        if header.spec != self._first.spec:
            who = f"the journal of seed {header.seed}"
            raise MismatchError("robot, task or cameras", who, header.spec, "the first", self._first.spec)
        for line in compare_fingerprints(
            f"the journal of seed {header.seed}", header.fingerprint, "the first", self._first.fingerprint
        ):
            _LOG.warning("%s", line)
        if self.is_full:
            return
        self._seeds = [*self._seeds[:1], header.seed]
        self._rollouts += 1
        for part in parts(episode):
            if not self.is_full:
                self._add_part(part)

    def _add_part(self, part: Episode) -> None:
        if self._recording.only_successes and not part.success:
            self.failed += 1
            return
        if self._recording.labels is not None:
            part = first_labels(part, self._recording.labels - self.labels)
        labels = count_labels(part)
        if self._recording.only_labelled and not labels:
            return
        self._writer.add(part)
        self.count += 1
        self.labels += labels

    def finish(self) -> DatasetInfo:
        """Make the dataset whole, with where it came from. Raises `NothingToLearnError` where no episode is left."""
        if not self.count:
            raise NothingToLearnError(
                "no episode has labels to learn from: the expert was never queried, or gave no valid label"
            )
        seeds = {"seeds": [self._seeds[0], self._seeds[-1]], "tried": self._rollouts} if self._seeds else {}
        return self._writer.finish({**self._recording.provenance, **seeds})


def build(journals: Path, root: Path, *, repo_id: str | None = None, replace: bool = False) -> BuildResult:
    """Return the LeRobot dataset of a folder of journals, in seed order: equal to what `record` writes as it goes.

    Files that cannot be read are left out and named in the result. Raises `ManipError` where no episode is left,
    `FolderExistsError` where `root` holds something, unless `replace` is to swap it for the new one at the end.
    """
    recording = Recording.read(journals)
    if repo_id is not None:
        recording = dataclasses.replace(recording, repo_id=repo_id)
    damaged: list[str] = []
    readable = _read_all(journals, damaged)
    first = next(readable, None)
    if first is None:
        raise ManipError(f"{journals} holds no readable episode{f': {damaged[0]}' if damaged else ''}")
    header = first[0]
    with recording.open(root, header.spec, header.fingerprint, replace=replace) as writer:
        builder = Builder(writer, recording)
        for one in itertools.chain([first], readable):
            builder.add(*one)
            if builder.is_full:
                break
        info = builder.finish()
    return BuildResult(info, builder.failed, tuple(damaged))


def _read_all(journals: Path, damaged: list[str]) -> Iterator[tuple[Header, Episode]]:
    for path in list_episodes(journals):
        try:
            yield read_journal(path)
        except ManipError as error:
            damaged.append(str(error))
