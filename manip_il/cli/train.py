"""`manip-il train`: behaviour cloning on datasets, with any policy that LeRobot knows."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Sequence
from dataclasses import MISSING, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from manip_il.cli import common_options as common
from manip_il.cli.common_options import exists, require_dataset, start_policy
from manip_il.cli.options import Given, given, group
from manip_il.cli.outputs import ResumableOutput
from manip_il.cli.progress import Stages, progress, say, set_quiet, warn
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.option import option

if TYPE_CHECKING:  # the learner takes a second to import
    import numpy as np
    from numpy.typing import NDArray

    from manip_il.data.dataset import Dataset
    from manip_il.learn.sources import Sources

RANK = "RANK"  # the variable by which processes that were started together know their place


@dataclass
class SourceGroup:
    """`--dataset.*` of what is learnt from."""

    root: list[Path] = option(
        MISSING, "folder of a LeRobot v3.0 dataset; several to learn from all", check=require_dataset, free=True
    )
    weights: list[float] = option(list, "share of the samples drawn from each of several; by default by its frames")


@dataclass
class TrainOptions:
    """Fit a policy to the labels of a dataset, or of several of one robot (behaviour cloning).

    --policy.type is mlp, cnn or any policy of LeRobot's (act, diffusion, vqbet, ...); its options have LeRobot's names:
    manip-il train --policy.type=act --help lists them. The checkpoint is LeRobot's:
    OUTPUT_DIR/checkpoints/last/pretrained_model.
    """

    example: ClassVar[str] = (
        "manip-il train --dataset.root=datasets/demos --policy.type=act --observation=state --output_dir=runs/act"
    )
    first: ClassVar[str] = "dataset.root policy observation action_space steps batch_size output_dir resume"
    dataset: SourceGroup
    weights: Path | None = option(
        None,
        "draw frames by the progress in this file of manip-il data score, as LeRobot's RA-BC weighs them",
        check=exists("rabc.parquet of manip-il data score"),
    )
    fit: Given = given(FitConfig, prefix="")
    seed: int = option(0, "seed of weights and batches, 0 to 1000", at_least=0, at_most=1000)
    trust: bool = common.trust_option()
    output: ResumableOutput = group(ResumableOutput(Path("runs/train")), prefix="")

    def run(self) -> None:
        """Read the datasets, fit, and say where the checkpoint is."""
        writes = os.environ.get(RANK, "0") == "0"  # whether this is the one of several processes that does
        if not writes:
            set_quiet(True)
        config, folder = self.config(), self.output.output_dir
        from manip_il.learn.lerobot_config import lerobot_options  # takes seconds

        options, _ = lerobot_options(config)  # refuses what LeRobot would, before anything is written
        sources = self._sources(config)
        weights = self._frame_weights(getattr(options.policy, "chunk_size", None), sources.datasets)
        with self.output.open(self) if writes else contextlib.nullcontext():
            path = self._fit(config, options.save_freq, sources, weights)
        if writes:
            own_names = common.own_names(sources.spec.robot, sources.spec.task, sources.spec.object)
            say(f"checkpoint: {path}")
            say(f"next: manip-il eval --policy.path={path}{own_names} --output_dir={folder}/eval")

    def config(self) -> FitConfig:
        """Return what the trainer takes; `UsageError` for what does not go together."""
        from manip_il.seeding import stream_base

        policy, seed = start_policy(self.fit.get("policy", {})), stream_base("training", self.seed)
        own: Given = {"policy": policy, "seed": seed, "trust": self.trust}
        return FitConfig(**self.fit | own)

    def _sources(self, config: FitConfig) -> Sources:
        """Return the datasets, which must agree with the first and have what the policy looks at."""
        from manip_il.cli.inputs import dataset_differences
        from manip_il.data.dataset import Dataset
        from manip_il.learn.names import PLAIN
        from manip_il.learn.sources import Sources, check_same_sources, input_columns

        sources = Sources(tuple(map(Dataset.open, self.dataset.root)), tuple(self.dataset.weights))
        specs, language = [one.spec for one in sources.datasets], config.kind not in PLAIN
        check_same_sources(sources.roots, specs, pictures=config.takes_images, language=language)
        for one in sources.datasets:
            seen = input_columns(config, one.root, one.info)
            warn(*dataset_differences(str(one.root), one.spec, one.fingerprint))
            odd = [key for key in one.cameras if config.takes_images and key not in seen]
            warn(*(f"{one.root}: {key} is left out: it holds depth, or no RGB pictures" for key in odd))
        return sources

    def _frame_weights(self, chunk: int | None, datasets: Sequence[Dataset]) -> NDArray[np.float64] | None:
        """Return how often each frame is drawn, relative to the others, (N,); None if all are drawn alike."""
        if self.weights is None:
            return None
        if len(datasets) > 1:
            raise UsageError("--weights is for the frames of one dataset; give one --dataset.root")
        from manip_il.learn.samples import rabc_weights

        episodes = datasets[0].columns(["episode_index"])["episode_index"].astype("int64")
        weights = rabc_weights(self.weights, episodes, chunk or int(datasets[0].fps))
        say(f"{(weights == 0).mean():.1%} of the frames weigh 0, {(weights == 1).mean():.1%} weigh 1")
        return weights

    def _fit(self, config: FitConfig, save_freq: int, sources: Sources, weights: NDArray[np.float64] | None) -> Path:
        from manip_il.learn.train import Trainer

        folder, resume = self.output.output_dir, self.output.resume
        pictures = sum(len(one) * len(one.cameras) for one in sources.datasets) if config.takes_images else 0
        with progress(pictures, "decode pictures, once") as bar:
            trainer = Trainer(sources, config, folder, resume=resume, on_frames=bar.step, weights=weights)
        with Stages(f"every finished checkpoint in {folder} (one every {save_freq:,} steps)") as stages:
            stages.start(f"train {config.kind} on {len(trainer.data.train):,} samples", config.total_steps)
            return trainer.fit(stages.log)
