"""Make datasets of what is on disk: of a folder of journals, of several datasets, of one with other numbers."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import json
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import write_file
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.episodes import Selection
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.info import DatasetInfo
from manip_il.data.journal import Header, list_episodes, read_journal
from manip_il.data.lerobot_write import Columns, EpisodeWriter, new_dataset
from manip_il.data.schema import RobotTaskSpec, check_same_spec
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, MismatchError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
RECORDING = "recording.json"


@dataclass(frozen=True)
class Recording:
    """The dataset that a folder of journals becomes: its `recording.json`.

    A rollout becomes as many episodes as it has parts (see `parts`). only_successes: failed ones are left out.
    only_labelled: those without a valid label are. episodes: at most so many, the first in seed order; None: all.
    labels: at most so many valid ones; after the last one `label_valid` is 0, episodes beyond it are left out.
    provenance: who drove, for the dataset's own. video: how pictures are compressed, as `VideoConfig` has it. stills:
    they are PNGs in the data files, for frames that have nothing to do with each other.
    """

    repo_id: str
    only_successes: bool = False
    episodes: int | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    video: dict[str, Any] = field(default_factory=dict)
    only_labelled: bool = False
    labels: int | None = None
    stills: bool = False

    def selection(self) -> Selection:
        """Return its rules, with nothing taken yet."""
        return Selection(self.only_successes, self.only_labelled, self.episodes, self.labels)

    def open(
        self, root: Path, spec: RobotTaskSpec, fingerprint: Mapping[str, Any], *, replace: bool = False
    ) -> AbstractContextManager[EpisodeWriter]:
        """Return the dataset's writer; raises what `new_dataset` raises."""
        video, spec = VideoConfig.from_json(self.video), dataclasses.replace(spec, video=not self.stills)
        return new_dataset(root, spec, repo_id=self.repo_id, fingerprint=fingerprint, video=video, replace=replace)

    def write(self, journals: Path) -> None:
        """Write `recording.json` beside the journals."""
        journals.mkdir(parents=True, exist_ok=True)
        write_file(journals / RECORDING, (json.dumps(asdict(self), indent=1) + "\n").encode())

    @classmethod
    def read(cls, journals: Path) -> Recording:
        """Return the folder's recording; where it has none, one that takes every episode."""
        path = journals / RECORDING
        if not path.is_file():
            return cls(local_id(journals.absolute().name.removesuffix(".journals") or "journals"))
        data = checks.read_json(path, "what a recording's journals become")
        known = {one.name: data[one.name] for one in fields(cls) if one.name in data}
        checks.repo_id(f"{path}: repo_id", known.get("repo_id"))
        return cls(**known)


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


def build(journals: Path, root: Path, *, repo_id: str | None = None, replace: bool = False) -> BuildResult:
    """Build the LeRobot dataset of a folder of journals, in seed order: equal to what `record` writes as it goes.

    Files that cannot be read are left out and named in the result. Raises `ManipError` where no episode is left,
    `FolderExistsError` where `root` holds something, unless `replace` is to swap it for the new one at the end.
    """
    recording = Recording.read(journals)
    if repo_id is not None:
        recording = dataclasses.replace(recording, repo_id=repo_id)
    selection = recording.selection()
    damaged: list[str] = []
    readable = _read_until_full(journals, selection, damaged)
    first = next(readable, None)
    if first is None:
        raise ManipError(f"{journals} holds no readable episode{f': {damaged[0]}' if damaged else ''}")
    header = first[0]
    with recording.open(root, header.spec, header.fingerprint, replace=replace) as writer:
        for episode in selection.take(itertools.chain([first], readable)):
            writer.add(episode)
        info = writer.finish(recording.provenance | selection.provenance)
    return BuildResult(info, selection.failed, tuple(damaged))


def _read_until_full(journals: Path, selection: Selection, damaged: list[str]) -> Iterator[tuple[Header, Episode]]:
    for path in list_episodes(journals):
        try:
            entry = read_journal(path)
        except ManipError as error:
            damaged.append(str(error))
            continue
        yield entry
        if selection.is_full:
            return


def merge_datasets(
    roots: Sequence[Path],
    root: Path,
    *,
    repo_id: str,
    fingerprint: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> DatasetInfo:
    """Merge the episodes of several datasets, in order, into one: equal to `write_dataset` of them.

    The fingerprint is the first one's unless given; if theirs differ, a warning is logged. The provenance names the
    sources and theirs, beside what is given. Films are copied. Raises `MismatchError` naming both sides if the specs
    differ.
    """
    if not roots:
        raise ManipError("no datasets to merge")
    opened = [Dataset.open(source) for source in roots]
    specs, first = [one.spec for one in opened], opened[0].fingerprint
    for one in opened:
        _check_mergeable(str(roots[0]), specs[0], str(one.root), one.spec)
        for warning in compare_fingerprints(str(roots[0]), first, str(one.root), one.fingerprint):
            _LOG.warning("%s", warning)
    sources = [{"name": one.root.name, "provenance": dict(one.provenance)} for one in opened]
    spec = next((spec for spec in specs if spec.task != UNKNOWN_TASK), specs[0])
    films = bool(spec.cameras and spec.video)
    with new_dataset(root, spec, repo_id=repo_id, fingerprint=first if fingerprint is None else fingerprint) as writer:
        for one in opened:
            for number, episode in enumerate(one.read_episodes(pictures=not films)):
                writer.add(episode, (one, number) if films else None)
        return writer.finish({**(provenance or {}), "merged": sources})


def rewrite_columns(
    dataset: Dataset, target: Path, columns: Iterable[Columns], provenance: Mapping[str, Any], **options: Any
) -> DatasetInfo:
    """Write a dataset to `target` with these columns in place of its own; films are copied.

    columns: of every episode in stored order, name -> (T,) or (T, d). options: those of `new_dataset`. Raises what
    `new_dataset` and `EpisodeWriter` raise, `ManipError` for columns of other lengths than the episodes.
    """
    spec = dataset.spec
    episodes = dataset.read_episodes(pictures=not spec.video)
    with new_dataset(target, spec, **options) as writer:
        for number, (episode, fresh) in enumerate(zip(episodes, columns, strict=True)):
            own = episode.columns | {key: values.reshape(len(values), -1) for key, values in fresh.items()}
            changed = dataclasses.replace(episode, columns=own)
            writer.add(changed, (dataset, number) if spec.video and spec.cameras else None)
        return writer.finish(provenance)


def dataset_sha256(root: Path) -> str:
    """Return the hash of what a dataset says in numbers: its description, statistics and columns, not its videos."""
    digest = hashlib.sha256()
    for path in (root / layout.INFO, root / layout.STATS, *sorted(root.glob(layout.DATA_FILES))):
        with open(checks.open_regular(path), "rb") as file:
            digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _check_mergeable(left_name: str, left: RobotTaskSpec, right_name: str, right: RobotTaskSpec) -> None:
    """Compare what must be the same for a policy, and what a dataset has only one of."""
    check_same_spec(left_name, left, right_name, right)
    for what in ("sim_state_size", "task"):
        left_value, right_value = getattr(left, what), getattr(right, what)
        if left_value != right_value and UNKNOWN_TASK not in (left_value, right_value):
            raise MismatchError(what, left_name, left_value, right_name, right_value)
