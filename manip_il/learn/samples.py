"""The samples of a fit in memory: numbers as tables, pictures decoded once.

A sample may include frames around its own, its window, which LeRobot's policies define by
`*_delta_indices`. Frames outside the episode are replaced by the nearest one inside, and
`<column>_is_pad` marks them.

Training on several datasets as one: what must agree between them, and how often each is sampled.

Normalisation statistics cover the frames of all datasets, each counted once, whatever the weights.
The weights can thus change without changing the units in which a policy observes and acts.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import torch
from lerobot.configs import PreTrainedConfig
from numpy.typing import NDArray

from manip_il.data.camera import decode
from manip_il.data.dataset import UNKNOWN_TASK, Dataset, JoinedDatasets, joined_columns
from manip_il.data.info import Info
from manip_il.data.lerobot_layout import EPISODE_INDEX, FRAME_INDEX, INDEX, TASK_INDEX, TIMESTAMP
from manip_il.data.schema import ACTION, ENVIRONMENT_STATE, LABEL_VALID, STATE, check_same_spec
from manip_il.data.statistics import column_statistics
from manip_il.errors import ManipError, MismatchError, UsageError
from manip_il.learn.action_spaces import Conversion
from manip_il.learn.checkpoint import in_one_line
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.names import MLP
from manip_il.mdp import F64, I64, require_finite
from manip_il.worlds.contract import EnvironmentSpec

Table = Mapping[str, NDArray[Any]]
Batch = dict[str, Any]  # as from LeRobot's DataLoader: tensors, and `task` as a list of strings
TASK = "task"
_ALWAYS = (EPISODE_INDEX, FRAME_INDEX, INDEX, TASK_INDEX, TIMESTAMP)  # LeRobot's own columns
_MAX_HELD_OUT = 1_024  # number of validation samples


@dataclass(frozen=True)
class Windows:
    """The frames that each sample consists of.

    Attributes:
        episodes: The episode of every frame, (N,), ascending.
        deltas: Offsets from the sample's own frame, (K,), by column; other columns have only the
            sample's own frame.
    """

    episodes: I64
    deltas: Mapping[str, I64]

    @cached_property
    def _first(self) -> I64:
        """Return the row of the first frame of every frame's episode, (N,)."""
        return np.searchsorted(self.episodes, self.episodes)

    @cached_property
    def _last(self) -> I64:
        return np.searchsorted(self.episodes, self.episodes, side="right") - 1

    def rows(self, samples: I64, key: str) -> tuple[I64, Batch]:
        """Return the row numbers of a column's windows.

        Args:
            samples: The samples' own rows, (B,).
            key: The column.

        Returns:
            The row numbers, (B, K), and the padding mask, (B, K), under the name `<column>_is_pad`.
            For a column without a window, `samples` themselves, (B,), and no mask.
        """
        if key not in self.deltas:
            return samples, {}
        wanted = samples[:, None] + self.deltas[key]
        inside = np.clip(wanted, self._first[samples, None], self._last[samples, None])
        return inside, {f"{key}_is_pad": torch.from_numpy(inside != wanted)}

    def usable(self, valid: NDArray[np.bool_], drop_last: int = 0) -> I64:
        """Return the samples to train on, (S,): those with valid labels in the whole window.

        Args:
            valid: Whether each frame's label is valid, (N,).
            drop_last: Number of unused frames at the end of each episode, LeRobot's
                `drop_n_last_frames`.

        Raises:
            ManipError: Nothing is left.
        """
        samples = np.flatnonzero(np.arange(len(valid)) + drop_last <= self._last)
        sound = valid[self.rows(samples, ACTION)[0]]
        samples = samples[sound if sound.ndim == 1 else sound.all(axis=1)]
        if len(samples) == 0:
            raise ManipError(
                f"none of {len(valid)} frames has valid labels in its whole window, so there is"
                " nothing to learn from"
            )
        return samples


@dataclass(frozen=True)
class Samples:
    """Samples in memory; a batch is one gather per column.

    Attributes:
        windows: The frames that each sample consists of.
        columns: Numeric columns, (N, d) or (N,), by LeRobot's names.
        pictures: Pictures uint8 (N, 3, H, W) by camera column.
        tasks: The text of every `task_index`, (M,).
        train: Rows of the samples to train on, (S,).
        held_out: Rows of the samples to validate with, (S,).
    """

    windows: Windows
    columns: dict[str, torch.Tensor]
    pictures: dict[str, NDArray[np.uint8]]
    tasks: NDArray[np.object_]
    train: I64
    held_out: I64

    def batch(self, samples: I64) -> Batch:
        """Return the batch of these samples, (B,); pictures are uint8."""
        batch: Batch = {}
        for key in (*self.columns, *self.pictures):
            rows, padded = self.windows.rows(samples, key)
            pictured = key in self.pictures
            batch[key] = (
                torch.from_numpy(self.pictures[key][rows]) if pictured else self.columns[key][rows]
            )
            batch |= padded
        batch[TASK] = self.tasks[batch[TASK_INDEX].numpy()].tolist()
        return batch


def load_data(
    policy: PreTrainedConfig,
    meta: JoinedDatasets,
    *,
    eval_split: float,
    seed: int,
    conversion: Conversion | None = None,
    on_frames: Callable[[int], None] | None = None,
) -> Samples:
    """Return the samples of the concatenated datasets.

    Args:
        policy: The policy's options, with features.
        meta: The datasets. Its `table` becomes the numeric columns, and its statistics those of the
            encoded actions.
        eval_split: Share of the episodes that are held out.
        seed: Decides which episodes are held out.
        conversion: Converts actions to targets; None if the targets are the datasets' actions.
        on_frames: Called with the number of newly decoded frames.

    Raises:
        NotFiniteError: A column holds a number that is not finite.
        ManipError: No frame has a valid label in its whole window.
    """
    wanted = [*(policy.input_features or {}), ACTION]
    if getattr(policy, "aux_weight", 0) and ENVIRONMENT_STATE not in wanted:  # the cnn predicts it
        wanted.append(ENVIRONMENT_STATE)
    features = [key for key in wanted if key in meta.features]
    cameras = [key for key in features if key in meta.camera_keys]
    numbers = [key for key in features if key not in cameras]
    table = joined_columns(meta.datasets, [*numbers, *_ALWAYS])
    table[LABEL_VALID] = np.concatenate([label_valid(dataset) for dataset in meta.datasets])
    table[TASK_INDEX] = meta.joint_tasks(table[TASK_INDEX])
    for key in numbers:
        # a column with one number per frame becomes a vector, too
        table[key] = table[key].reshape(len(table[key]), -1)
        require_finite(f"column {key}", table[key])
    if conversion is not None:
        table[ACTION] = conversion.encode(table[ACTION].astype(np.float32), table[STATE])
        meta.stats |= column_statistics({ACTION: table[ACTION]})
    meta.table = table
    episodes = table[EPISODE_INDEX].astype(np.int64)
    deltas = dict.fromkeys(features, policy.observation_delta_indices)
    deltas[ACTION] = policy.action_delta_indices
    windows = Windows(
        episodes, {key: np.asarray(one, np.int64) for key, one in deltas.items() if one is not None}
    )
    usable = windows.usable(table[LABEL_VALID] != 0, getattr(policy, "drop_n_last_frames", 0))
    train, held_out = split_by_episode(episodes[usable], eval_split, seed)
    if len(held_out) > _MAX_HELD_OUT:
        held_out = held_out[np.linspace(0, len(held_out) - 1, _MAX_HELD_OUT).astype(np.int64)]
    return Samples(
        windows,
        {key: torch.from_numpy(table[key]) for key in (*numbers, *_ALWAYS)},
        {
            key: decode([dataset.camera(key) for dataset in meta.datasets], on_frames)
            for key in cameras
        },
        np.array(meta.tasks, object),
        usable[train],
        usable[held_out],
    )


def label_valid(dataset: Dataset) -> NDArray[Any]:
    """Return a dataset's `label_valid`, (N,), which says whether a frame counts in the loss: 1
    without such a column.
    """
    if LABEL_VALID not in dataset.features:
        return np.ones(len(dataset), np.int64)
    return dataset.columns([LABEL_VALID])[LABEL_VALID].reshape(-1)


def split_by_episode(episodes: I64, fraction: float, seed: int) -> tuple[I64, I64]:
    """Return the rows to train on and to hold out; whole episodes are held out.

    Args:
        episodes: The episode of every row, (N,).
        fraction: Share of the episodes to hold out. Nothing is held out if it rounds to none or all
            of them.
        seed: Decides which episodes are held out.

    Returns:
        Row numbers to train on, (N - h,), and to hold out, (h,), both ascending.
    """
    names = np.random.default_rng([seed, 1]).permutation(np.unique(episodes))
    count = round(fraction * len(names))
    mask = np.isin(episodes, names[: count % len(names)])
    return np.flatnonzero(~mask), np.flatnonzero(mask)


def rabc_weights(path: Path, episodes: I64, ahead: int) -> F64:
    """Return the weight of every frame, from a file with the progress of every frame.

    The weights are those of LeRobot's RA-BC (Chen et al. 2025, arXiv:2509.25358, equations 8 and
    9). LeRobot multiplies losses by them; here samples are drawn in proportion to them, which gives
    the same mean gradient.

    Args:
        path: The file, as LeRobot writes it (`rabc.parquet`).
        episodes: The dataset's `episode_index`, (N,).
        ahead: Number of frames over which the gain in progress is measured.

    Returns:
        Weights (N,) in [0, 1], the greatest of which is 1.

    Raises:
        ManipError: The file cannot be read, or every frame weighs 0.
        MismatchError: The file belongs to another dataset.
    """
    from lerobot.rewards.sarm.rabc import RABCWeights  # its import takes seconds

    with in_one_line(f"{path} is not a file of weights"):
        found = RABCWeights(path, chunk_size=ahead, device=torch.device("cpu"))
    if found.episode_lookup != dict(enumerate(episodes.tolist())):
        frames = f"{len(found.episode_lookup)} frames"
        raise MismatchError(
            "division into episodes", str(path), frames, "the dataset", f"{len(episodes)} frames"
        )
    weights, _ = found.compute_batch_weights({"index": np.arange(len(episodes))})
    if not weights.any():
        raise ManipError(
            f"all {len(weights)} frames weigh 0, as progress falls after each; there is nothing to"
            " learn from"
        )
    return (weights / weights.max()).double().numpy()


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
