"""Make datasets: from rollouts or journals, by merging datasets, or by replacing columns of one."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import logging
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import write_json
from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.episodes import parts
from manip_il.data.fingerprint import compare_fingerprints, file_sha256
from manip_il.data.info import Info, reading
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.lerobot_write import Columns, Films, write_dataset
from manip_il.data.schema import LABEL_VALID, check_same_spec
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, MismatchError, NothingToLearnError
from manip_il.mdp import Episode

_LOG = logging.getLogger(__name__)
RECORDING = "recording.json"
Rollouts = Iterable[tuple[Journal, Episode]]


@dataclass(frozen=True)
class Recording:
    """Settings for making a dataset from rollouts, stored as `recording.json` in the folder of their journals.

    A rollout becomes one episode per part (see `parts`). only_successes: leave out failed episodes. only_labelled:
    leave out episodes without a valid label. episodes: number of episodes to keep, in seed order; None: all. labels:
    number of valid labels to keep; later ones have `label_valid` 0, and later episodes are left out. provenance: who
    drove, stored in the dataset. video: fields of `VideoConfig`.
    """

    repo_id: str
    only_successes: bool = False
    episodes: int | None = None
    provenance: dict[str, Any] = field(default_factory=dict)
    video: dict[str, Any] = field(default_factory=dict)
    only_labelled: bool = False
    labels: int | None = None

    def write(self, journals: Path) -> None:
        """Write `recording.json` into the folder of journals."""
        write_json(journals / RECORDING, asdict(self))

    @classmethod
    def read(cls, journals: Path) -> Recording:
        """Return the settings in `recording.json`; if it is missing, settings that keep every episode."""
        path = journals / RECORDING
        if not path.is_file():
            return cls(local_id(journals.absolute().name.removesuffix(".journals") or "journals"))
        with reading(path):
            data = checks.read_json(path, "the settings of a recording")
            return cls(**{one.name: data[one.name] for one in fields(cls) if one.name in data})

    def make(self, rollouts: Rollouts, root: Path, *, replace: bool = False) -> tuple[Info, int]:
        """Write rollouts as a dataset; return its info and the number of failed episodes left out.

        rollouts: in seed order; all are consumed, even after a limit is reached. Spec and fingerprint are the first
        rollout's; if another fingerprint differs, a warning is logged. The selection depends on the rollouts alone, so
        that recording directly and building later give the same bytes. Raises what `write_dataset` raises,
        `MismatchError` for a rollout of another robot, task or cameras, `NothingToLearnError` if there is no episode.
        """
        rollouts = iter(rollouts)
        if (first := next(rollouts, None)) is None:
            raise NothingToLearnError("no episode was recorded")
        about, seeds, failed, found = first[0], list[int](), 0, 0
        provenance = dict(self.provenance)

        def selected() -> Iterator[Episode]:
            nonlocal failed, found
            labels = 0
            for journal, rollout in itertools.chain([first], rollouts):
                name = f"the journal of seed {rollout.seed}"
                if journal.spec != about.spec:
                    raise MismatchError(
                        "spec (robot, task or cameras)", name, journal.spec, "the first journal", about.spec
                    )
                for line in compare_fingerprints(name, journal.fingerprint, "the first journal", about.fingerprint):
                    _LOG.warning("%s", line)
                if self._is_full(found, labels):
                    continue
                seeds.append(rollout.seed)
                for part in parts(rollout):
                    if self._is_full(found, labels):
                        break
                    if self.only_successes and not part.success:
                        failed += 1
                        continue
                    if self.labels is not None:
                        part = _first_labels(part, self.labels - labels)
                    own = int(part.columns[LABEL_VALID].sum()) if LABEL_VALID in part.columns else 0
                    if own or not self.only_labelled:
                        yield part
                        found, labels = found + 1, labels + own
            if not found:
                raise NothingToLearnError(
                    "no episode has labels to learn from: the expert was never queried or gave no valid label"
                )
            provenance.update(seeds=[seeds[0], seeds[-1]], tried=len(seeds))

        video = VideoConfig(**self.video)
        options: dict[str, Any] = {"repo_id": self.repo_id, "fingerprint": about.fingerprint, "video": video}
        return write_dataset(selected(), root, about.spec, provenance, replace=replace, **options), failed

    def _is_full(self, episodes: int, labels: int) -> bool:
        limits = (self.episodes, episodes), (self.labels, labels)
        return any(most is not None and found >= most for most, found in limits)


def _first_labels(episode: Episode, most: int) -> Episode:
    """Return the episode with `label_valid` 0 after its first `most` valid labels."""
    valid = episode.columns[LABEL_VALID].astype(np.int64)
    kept = valid * (np.cumsum(valid).reshape(valid.shape) <= most)
    return dataclasses.replace(episode, columns=episode.columns | {LABEL_VALID: kept})


def local_id(folder: str) -> str:
    """Return the repository id, `local/NAME`, for a folder's name, which may have any characters."""
    name = re.sub(r"\.{2,}", ".", re.sub(r"[^A-Za-z0-9_.\-]+", "_", folder)).lstrip(".")
    return f"local/{name[: checks.LONGEST_NAME] or 'dataset'}"


def build(journals: Path, root: Path, *, replace: bool = False) -> tuple[Info, int]:
    """Build a LeRobot dataset from a folder of journals, in seed order, equal to the dataset that `record` writes.

    Returns and raises what `Recording.make` does. Also raises `ManipError` if journals are missing or damaged.
    replace: replace an existing `root`; otherwise raises `FolderExistsError` if `root` is not empty.
    """
    recording = Recording.read(journals)
    if not (paths := list_episodes(journals)):
        raise ManipError(f"{journals} holds no episode")
    return recording.make(map(read_journal, paths), root, replace=replace)


def merge_datasets(
    roots: Sequence[Path],
    root: Path,
    *,
    repo_id: str,
    provenance: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> Info:
    """Merge several datasets, in order, into one; equal to `write_dataset` of all their episodes.

    The fingerprint is the first dataset's; if another differs, a warning is logged. The names and provenance of the
    sources are added to `provenance`. Video files are copied. Raises `MismatchError` naming both sides if the specs
    differ.
    """
    opened = [Dataset.open(source) for source in roots]
    about = next((one for one in opened if one.spec.task != UNKNOWN_TASK), opened[0])
    own = opened[0].fingerprint
    for one in opened:
        also = ("sim_state_size", "cameras", "image_size", *(("task",) if one.spec.task != UNKNOWN_TASK else ()))
        check_same_spec(str(about.root), about.spec, str(one.root), one.spec, also)
        for warning in compare_fingerprints(str(roots[0]), own, str(one.root), one.fingerprint):
            _LOG.warning("%s", warning)
    sources = [{"name": one.root.name, "provenance": dict(one.provenance)} for one in opened]
    options: dict[str, Any] = {"repo_id": repo_id, "fingerprint": own, "replace": replace}
    episodes = itertools.chain.from_iterable(map(_with_films, opened))
    spec = dataclasses.replace(about.spec, video=any(one.spec.video for one in opened))
    return write_dataset(episodes, root, spec, {**(provenance or {}), "merged": sources}, **options)


def rewrite_columns(
    dataset: Dataset, target: Path, columns: Iterable[Columns], provenance: Mapping[str, Any], **options: Any
) -> Info:
    """Write a dataset to `target` with some columns replaced; video files are copied.

    columns: for every episode in stored order, name -> (T,) or (T, d). options: those of `write_dataset`. Raises what
    `write_dataset` raises, and `ManipError` if a column and its episode differ in length.
    """

    def changed() -> Iterator[tuple[Episode, Films | None]]:
        for (episode, films), fresh in zip(_with_films(dataset), columns, strict=True):
            own = episode.columns | {key: values.reshape(len(values), -1) for key, values in fresh.items()}
            yield dataclasses.replace(episode, columns=own), films

    return write_dataset(changed(), target, dataset.spec, provenance, **options)


def _with_films(dataset: Dataset) -> Iterator[tuple[Episode, Films | None]]:
    """Yield the episodes of a dataset; pictures in video files are not decoded but passed on as `Films`."""
    films = bool(dataset.spec.cameras and dataset.spec.video)
    for number, episode in enumerate(dataset.read_episodes(pictures=not films)):
        yield episode, (dataset, number) if films else None


def dataset_sha256(root: Path) -> str:
    """Return the hash of a dataset's description, statistics and columns, without its videos."""
    digest = hashlib.sha256()
    for path in (root / layout.INFO, root / layout.STATS, *sorted(root.glob(layout.DATA_FILES))):
        digest.update(file_sha256(path))
    return digest.hexdigest()
