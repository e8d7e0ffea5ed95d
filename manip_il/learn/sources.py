"""Training on several datasets as one: what must agree between them, and how often each is sampled.

Normalisation statistics cover the frames of all datasets, each counted once, whatever the weights.
The weights can thus change without changing the units in which a policy observes and acts.
"""

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from manip_il.data.dataset import UNKNOWN_TASK, Dataset
from manip_il.data.info import Info
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, STATE, check_same_spec
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import MLP
from manip_il.mdp import F64, I64
from manip_il.worlds.contract import EnvironmentSpec


def row_weights(datasets: Sequence[Dataset], shares: Sequence[float], rows: I64) -> F64:
    """Return the relative sampling weight of each training row.

    The rows of a dataset share its weight equally.

    Args:
        datasets: The datasets.
        shares: Relative shares of the samples drawn from each dataset.
        rows: Frame numbers in the concatenated datasets, (S,).

    Returns:
        Weights (S,), which sum to the shares of the datasets that have rows.
    """
    which = np.searchsorted(np.cumsum([*map(len, datasets)]), rows, side="right")
    return np.asarray(shares)[which] / np.bincount(which)[which]


def check_shares(shares: Sequence[float], datasets: Sequence[Dataset]) -> None:
    """Raise `UsageError` unless there are no shares, or a positive one for each dataset."""
    wrong = len(shares) != len(datasets) or not all(0 < share < math.inf for share in shares)
    if shares and wrong:
        raise UsageError(
            f"the weights of {len(datasets)} datasets are {list(shares)}; expected a number above"
            " 0 for each"
        )


def check_same_sources(
    specs: Mapping[Any, EnvironmentSpec], *, pictures: bool, language: bool
) -> None:
    """Raise `MismatchError` unless several datasets can be used as one.

    Args:
        specs: The specifications of the datasets by their folders, which the message names.
        pictures: Whether the policy takes pictures, so that cameras and sizes must agree, too.
        language: Whether the policy reads an instruction; if not, the task must be the same.

    Raises:
        MismatchError: A dataset differs from the first; the message names both.
    """
    what = (*(("cameras", "image_size") if pictures else ()), *(() if language else ("task",)))
    (first, spec), *others = specs.items()
    for root, other in others:
        check_same_spec(str(first), spec, str(root), other)
        for name in what:
            left, right = getattr(spec, name), getattr(other, name)
            if left != right and UNKNOWN_TASK not in (left, right):
                raise MismatchError(name, str(first), left, str(root), right)


def input_columns(config: FitConfig, root: Path, info: Info) -> list[str]:
    """Return the columns of a dataset that a policy observes, by LeRobot's names.

    Without `observation.environment_state` the joints are enough for an mlp, and for any policy if
    there are no pictures either.

    Args:
        config: The options of the fit.
        root: The folder of the dataset, for the message.
        info: The dataset's `info.json`.

    Raises:
        ManipError: The dataset lacks a column; the message says what to do.
    """
    pictured = [key for key, feature in info.features.items() if feature.is_rgb]
    cameras = pictured if config.takes_images else []
    joints_alone = ENVIRONMENT_STATE not in info.features and (config.kind == MLP or not pictured)
    numbers = [STATE] if config.observes == "images" or joints_alone else [STATE, ENVIRONMENT_STATE]
    lacking = [name for name in (ACTION, *numbers) if name not in info.features]
    if config.takes_images and not cameras:
        lacking.append("pictures")
    if lacking:
        raise ManipError(
            f"{root}: the dataset has no {' and no '.join(lacking)}, which"
            f" --observation={config.observes} needs; choose another --observation or"
            " --policy.type, or record with manip-il"
            f" record{' --cameras=front,side' if config.takes_images else ''}"
        )
    return [*numbers, *cameras]


def recorded_look(
    provenance: Mapping[str, Any], fingerprint: Mapping[str, Any]
) -> dict[str, Any] | None:
    """Return the lighting of a dataset's pictures, as arguments of `sim.look.Look`.

    {} is the default.

    None if unknown: for another program's dataset, one without pictures, or one merged from
    different ones.
    """
    if "cameras_sha256" not in fingerprint:
        return None
    merged = (
        []
        if "rendered" in provenance
        else [one["provenance"] for one in provenance.get("merged", [])]
    )
    drawn = [one.get("rendered") or one.get("redrawn") or {} for one in merged or [provenance]]
    # `record` uses the default lighting
    looks = [dict((one.get("cameras") or {}).get("look", {})) for one in drawn]
    return looks[0] if all(look == looks[0] for look in looks) else None
