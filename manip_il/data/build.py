"""Make datasets: from rollouts or journals, or by merging datasets."""

from __future__ import annotations

import dataclasses
import hashlib
import itertools
import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from manip_il import checks
from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import write_json
from manip_il.data.dataset import Dataset, Own
from manip_il.data.episodes import parts
from manip_il.data.fingerprint import compare_fingerprints, file_sha256
from manip_il.data.info import PICTURES, Info, reading
from manip_il.data.joining import JoinedTasks
from manip_il.data.journal import Journal, list_episodes, read_journal
from manip_il.data.lerobot_write import write_dataset, write_episodes
from manip_il.data.schema import LABEL_VALID, check_same_spec
from manip_il.data.video_config import VideoConfig
from manip_il.errors import ManipError, MismatchError, NothingToLearnError, UsageError, warn
from manip_il.mdp import Episode

RECORDING = "recording.json"
_CODEC = ("video.codec", "video.pix_fmt")  # what all films of a camera have in common
Rollouts = Iterable[tuple[Journal, Episode]]


@dataclass(frozen=True)
class Recording:
    """Settings for making a dataset from rollouts.

    They are stored as `recording.json` in the folder of the rollouts' journals. A rollout becomes
    one episode per part (see `parts`).

    Attributes:
        only_successes: Whether failed episodes are left out.
        episodes: Number of episodes to keep, in seed order; None for all.
        provenance: Who drove; stored in the dataset.
        video: Fields of `VideoConfig`.
        only_labelled: Whether episodes without a valid label are left out.
        labels: Number of valid labels to keep, None for all; later ones have `label_valid` 0, and
            later episodes are left out.
    """

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
        """Return the settings in `recording.json`.

        If it is missing, settings that keep every episode.
        """
        path = journals / RECORDING
        if not path.is_file():
            return cls()
        with reading(path):
            settings = checks.read_json(path, "the settings of a recording")
            settings.pop("repo_id", None)  # which nothing read
            return cls(**settings)

    def make(self, rollouts: Rollouts, root: Path, *, replace: bool = False) -> tuple[Info, int]:
        """Write rollouts as a dataset; return its info and the number of failed episodes left out.

        Spec and fingerprint are the first rollout's; if another fingerprint differs, a warning is
        logged. The selection depends on the rollouts alone, so that recording directly and building
        later give the same bytes.

        Args:
            rollouts: In seed order; all are consumed, even after a limit is reached.
            root: The new folder.
            replace: Whether to replace a dataset of ours at `root`.

        Raises:
            MismatchError: A rollout has another robot, task or cameras.
            NothingToLearnError: There is no episode.
            FolderExistsError, ManipError: As in `write_dataset`.
        """
        rollouts = iter(rollouts)
        if (first := next(rollouts, None)) is None:
            raise NothingToLearnError("no episode was recorded")
        about = first[0]
        provenance = dict(self.provenance)
        failed: list[int] = []  # seeds

        def selected() -> Iterator[Episode]:
            episodes = math.inf if self.episodes is None else self.episodes  # still to be kept
            labels = math.inf if self.labels is None else self.labels
            seeds: list[int] = []
            empty = True
            for journal, rollout in itertools.chain([first], rollouts):
                _compare(journal, f"the journal of seed {rollout.seed}", about)
                if min(episodes, labels) > 0:
                    seeds.append(rollout.seed)
                for part in parts(rollout):
                    if min(episodes, labels) <= 0:
                        break
                    if self.only_successes and not part.success:
                        failed.append(rollout.seed)
                        continue
                    if self.labels is not None:
                        part = _first_labels(part, labels)
                    own = int(part.columns[LABEL_VALID].sum()) if LABEL_VALID in part.columns else 0
                    if own or not self.only_labelled:
                        yield part
                        empty = False
                        episodes -= 1
                        labels -= own
            if empty:
                raise NothingToLearnError(
                    "no episode has labels to learn from: the expert was never queried or gave no"
                    " valid label"
                )
            provenance.update(seeds=[seeds[0], seeds[-1]], tried=len(seeds))

        video = VideoConfig(**self.video)
        options: dict[str, Any] = {
            "fingerprint": about.fingerprint,
            "video": video,
            "replace": replace,
        }
        return write_dataset(selected(), root, about.spec, provenance, **options), len(failed)


def _compare(journal: Journal, name: str, about: Journal) -> None:
    """Raise `MismatchError` for another spec than the first journal's, and warn of another
    fingerprint.
    """
    first = "the first journal"
    if journal.spec != about.spec:
        raise MismatchError("spec (robot, task or cameras)", name, journal.spec, first, about.spec)
    warn(*compare_fingerprints(name, journal.fingerprint, first, about.fingerprint))


def _first_labels(episode: Episode, most: float) -> Episode:
    """Return the episode with `label_valid` 0 after its first `most` valid labels."""
    valid = episode.columns[LABEL_VALID].astype(np.int64)
    kept = valid * (np.cumsum(valid).reshape(valid.shape) <= most)
    return dataclasses.replace(episode, columns=episode.columns | {LABEL_VALID: kept})


def build(journals: Path, root: Path, *, replace: bool = False) -> tuple[Info, int]:
    """Build a LeRobot dataset from a folder of journals, equal to the one that `record` writes.

    Args:
        journals: The folder of journals, which are read in seed order.
        root: The new folder.
        replace: Whether to replace an existing dataset.

    Returns:
        The dataset's info and the number of failed episodes left out.

    Raises:
        FolderExistsError: if `root` is not empty and `replace` is false.
        UsageError: if the folder to replace is not a dataset of this program.
        MismatchError: if the journals differ in robot, task or cameras.
        NothingToLearnError: if no episode has labels.
        ManipError: if journals are missing or damaged, or the dataset cannot be written.
    """
    recording = Recording.read(journals)
    if not (paths := list_episodes(journals)):
        raise ManipError(f"{journals} holds no episode")
    return recording.make(map(read_journal, paths), root, replace=replace)


def merge_datasets(
    roots: Sequence[Path],
    root: Path,
    episodes: Sequence[str] = (),
    *,
    provenance: Mapping[str, Any] | None = None,
    replace: bool = False,
) -> Info:
    """Merge datasets, ours or others', in order, into one.

    Equal to `write_dataset` of all their episodes if ours.

    Datasets of ours with different tasks of one robot become one of several tasks.
    Every column, every frame's text and whole video files are copied. Datasets of ours are
    described as such: the fingerprint is the first one's, and if another differs, a warning is
    logged; the names and provenance of the sources are added to `provenance`.

    Args:
        roots: The datasets.
        root: The new one.
        provenance: Its origin, if a dataset is ours.
        replace: Whether to replace a dataset of ours at `root`.
        episodes: Episodes to keep, as in `choose_episodes`, numbered as in the merged datasets; by
            default all.

    Raises:
        MismatchError: Robot, rate, columns or codecs differ; names both sides.
        UsageError: An episode does not exist.
    """
    opened = [Dataset.open(source) for source in roots]
    kept = choose_episodes(episodes, sum(one.info.episodes for one in opened))
    if joined := JoinedTasks.of(opened, provenance or {}):
        own, features = joined.own, joined.features
        stored = joined.episodes()
    else:
        own, features = _merged_description(opened, provenance or {}), _merged_features(opened)
        stored = itertools.chain.from_iterable(one.stored_episodes() for one in opened)
    first = opened[0]
    for one in opened:
        _check_same_facts(first, one, ("film ", "meta/") if joined else ("",))
    return write_episodes(
        (one for number, one in enumerate(stored) if number in kept),
        root,
        features,
        first.fps,
        first.info.robot,
        own,
        tables=first.other_tables,
        replace=replace,
    )


def choose_episodes(words: Sequence[str], count: int) -> set[int]:
    """Return the numbers of the chosen episodes.

    Args:
        words: Numbers and ranges such as `7`, `0:50` (0 to 49) and `50:`; all if there are none.
        count: Number of episodes to choose from.

    Raises:
        UsageError: if a word is neither a number nor a range in `0:count`.
    """
    chosen: set[int] = set()
    for word in words or [":"]:
        first, colon, stop = word.partition(":")
        try:
            numbers = range(int(first or 0), int(stop or count) if colon else int(first) + 1)
        except ValueError:
            numbers = range(0)
        if not 0 <= numbers.start < numbers.stop <= count:
            raise UsageError(
                f"--dataset.episodes has {checks.shorten(word)}; expected numbers and ranges in"
                f" 0:{count}"
            )
        chosen.update(numbers)
    return chosen


def _merged_description(opened: Sequence[Dataset], provenance: Mapping[str, Any]) -> Own | None:
    """Return the content of `meta/manip_il.json` for merged datasets.

    None if no dataset is ours.
    """
    if (about := next((one for one in opened if one.own), None)) is None:
        return None
    own = opened[0].fingerprint
    for one in opened:
        also = ("sim_state_size", "image_size", *(("task",) if one.own else ()))
        check_same_spec(str(about.root), about.spec, str(one.root), one.spec, also)
        warn(*compare_fingerprints(str(opened[0].root), own, str(one.root), one.fingerprint))
    sources = [{"name": one.root.name, "provenance": dict(one.provenance)} for one in opened]
    spec = dataclasses.replace(about.spec, video=any(one.spec.video for one in opened))
    return Own(spec, own, {**provenance, "merged": sources})


def _merged_features(opened: Sequence[Dataset]) -> layout.Features:
    features: layout.Features = {}
    for one in opened:
        for key, feature in one.stored_features.items():
            # encoded if others have films
            if features.setdefault(key, feature)["dtype"] == "image":
                features[key] = feature
    return features


def _check_same_facts(left: Dataset, right: Dataset, kinds: tuple[str, ...]) -> None:
    """Raise `MismatchError` unless two datasets can be merged. kinds: which facts to compare, by
    the beginnings of their names.
    """
    ours, theirs = _facts(left), _facts(right)
    for what in filter(lambda name: name.startswith(kinds), {**ours, **theirs}):
        one, other = ours.get(what, "none"), theirs.get(what, "none")
        # no film, or not described as fully
        is_unknown = what.startswith("film ") and "none" in (one, other)
        if one != other and not is_unknown:
            raise MismatchError(what, str(left.root), one, str(right.root), other)


def _facts(dataset: Dataset) -> dict[str, str]:
    """Return what merged datasets must have in common: rate, robot, columns, films, other
    tables.
    """
    facts = {"fps": str(dataset.fps), "robot_type": dataset.info.robot or "none"}
    for key, one in dataset.features.items():
        kind = "pictures" if one.dtype in PICTURES else one.dtype
        facts[f"column {key}"] = f"{kind} of shape {[*one.shape]}, named {one.names}"
        facts |= {
            f"film {key}: {what}": one.details[what] for what in _CODEC if what in one.details
        }
    for key in {key for row in dataset.episodes.others for key in row} - {layout.DRAWN}:
        facts[f"column {key} of meta/episodes"] = "a column"
    for path in dataset.other_tables:
        facts[f"meta/{path.name}"] = f"sha256 {file_sha256(path).hex()}"
    return facts


def dataset_sha256(root: Path) -> str:
    """Return the hash of a dataset's description, statistics and columns, without its videos."""
    digest = hashlib.sha256()
    for path in (root / layout.INFO, root / layout.STATS, *sorted(root.glob(layout.DATA_FILES))):
        digest.update(file_sha256(path))
    return digest.hexdigest()
