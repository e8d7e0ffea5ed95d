"""One dataset of several."""

from __future__ import annotations

import itertools
import logging
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from manip_il.data import lerobot_layout as layout
from manip_il.data.atomic import new_folder
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.lerobot_read import (
    UNKNOWN_TASK,
    DatasetInfo,
    camera_keys,
    dataset_info,
    read_episodes,
    read_fingerprint,
    read_provenance,
    read_spec,
)
from manip_il.data.lerobot_write import own_file, write_dataset
from manip_il.data.schema import RobotTaskSpec, check_same_spec
from manip_il.errors import ManipError, MismatchError

_LOG = logging.getLogger(__name__)


def merge_datasets(
    roots: Sequence[Path],
    root: Path,
    *,
    repo_id: str,
    fingerprint: Mapping[str, Any] | None = None,
    provenance: Mapping[str, Any] | None = None,
) -> DatasetInfo:
    """Return one dataset of all episodes of several, in order: equal to `write_dataset` of them.

    The fingerprint is the first one's unless given; where theirs differ, a warning is logged. The provenance says
    what came from where, beside what is given. Datasets with cameras are joined by LeRobot, which copies their videos;
    its statistics of pictures are approximate. Raises `MismatchError` naming both sides where the specs differ.
    """
    if not roots:
        raise ManipError("no datasets to merge")
    specs, first = [read_spec(source) for source in roots], read_fingerprint(roots[0])
    for other, spec in zip(roots, specs, strict=True):
        _check_mergeable(str(roots[0]), specs[0], str(other), spec)
        for warning in compare_fingerprints(str(roots[0]), first, str(other), read_fingerprint(other)):
            _LOG.warning("%s", warning)
    sources = [{"name": source.name, "provenance": read_provenance(source)} for source in roots]
    spec = next((spec for spec in specs if spec.task != UNKNOWN_TASK), specs[0])
    origin = {**(provenance or {}), "merged": sources}
    fingerprint = first if fingerprint is None else fingerprint
    if any(camera_keys(source) for source in roots):
        return _join_by_lerobot(roots, root, repo_id, own_file(repo_id, spec, fingerprint, origin))
    episodes = itertools.chain.from_iterable(read_episodes(source) for source in roots)
    return write_dataset(episodes, root, spec, repo_id=repo_id, fingerprint=fingerprint, provenance=origin)


def _join_by_lerobot(roots: Sequence[Path], root: Path, repo_id: str, about: Mapping[str, Any]) -> DatasetInfo:
    from manip_il.data.lerobot_library import join_datasets  # imports torch

    with new_folder(root) as folder:
        work = folder / root.name  # LeRobot makes its folder itself
        join_datasets(roots, work, repo_id)
        for path in list(work.iterdir()):
            path.rename(folder / path.name)
        work.rmdir()
        layout.write_json(folder / layout.OURS, about)
    return dataset_info(root)


def _check_mergeable(left_name: str, left: RobotTaskSpec, right_name: str, right: RobotTaskSpec) -> None:
    """Beside what must be the same for a policy, what one dataset has only one of."""
    check_same_spec(left_name, left, right_name, right)
    for what in ("instruction", "sim_state_size", "task"):
        left_value, right_value = getattr(left, what), getattr(right, what)
        if left_value != right_value and UNKNOWN_TASK not in (left_value, right_value):
            raise MismatchError(what, left_name, left_value, right_name, right_value)
