"""Train a policy on datasets: behaviour cloning."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from manip_il.data.dataset import Dataset
from manip_il.data.ownership import output_of, require_ours
from manip_il.errors import UsageError
from manip_il.learn.checkpoint import Checkpoint
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.lerobot_config import policy_config
from manip_il.learn.policy_folder import with_folder
from manip_il.learn.samples import rabc_weights
from manip_il.learn.train import Trainer
from manip_il.mdp import F64
from manip_il.option import make_options
from manip_il.progress import Progress
from manip_il.seeding import stream_base

Data = Dataset | Path | str


def train(
    datasets: Data | Sequence[Data],
    output_dir: Path | str,
    *,
    seed: int = 0,
    shares: Sequence[float] = (),
    weights: Path | None = None,
    resume: bool = False,
    progress: Progress | None = None,
    **options: Any,
) -> Checkpoint:
    """Fit a policy to the labels of one or more datasets.

    Args:
        datasets: The datasets, or their folders.
        output_dir: The folder for checkpoints and metrics.
        seed: 0 to 1000.
        shares: Share of the samples from each dataset; by default its share of the frames.
        weights: `rabc.parquet` of the only dataset, by which its frames are drawn.
        resume: Whether to continue the fit in the folder.
        progress: Follows the fit.
        options: Fields of `FitConfig`, such as `policy={"type": "mlp", "width": 128}` and `steps`.

    Returns:
        The last checkpoint.

    Raises:
        UsageError: for an option that is unknown or invalid, or a folder with other files.
        ManipError: for data that do not fit the policy.
    """
    progress = progress or Progress()
    given = (datasets,) if isinstance(datasets, Data) else datasets
    folder = Path(output_dir).expanduser()
    require_ours(folder, output_of("Train"))
    opened = [one if isinstance(one, Dataset) else Dataset.open(Path(one).expanduser()) for one in given]
    options["policy"] = with_folder(options.get("policy", {}))
    config = make_options(FitConfig, seed=stream_base("training", seed), **options)
    drawn = None if weights is None else _frame_weights(weights, opened, config)
    pictures = sum(len(one) * len(one.cameras) for one in opened) if config.takes_images else 0
    progress.start("decode pictures, once", pictures)
    trainer = Trainer(
        opened,
        config,
        folder,
        shares=shares,
        weights=drawn,
        resume=resume,
        on_start=progress.started,
        on_frames=progress.step,
    )
    progress.start(f"train {config.kind} on {len(trainer.data.train):,} samples", config.total_steps)
    return Checkpoint.open(trainer.fit(progress.log))


def _frame_weights(path: Path, datasets: Sequence[Dataset], config: FitConfig) -> F64:
    if len(datasets) > 1:
        raise UsageError("weights are for the frames of one dataset; give one dataset")
    [dataset] = datasets
    episodes = dataset.columns(["episode_index"])["episode_index"].astype("int64")
    ahead = getattr(policy_config(config), "chunk_size", None) or round(dataset.fps)
    return rabc_weights(path, episodes, ahead)
