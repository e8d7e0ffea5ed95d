"""What a `cnn` sees in scenes that it was not trained on: errors of its predicted state.

Usage: python benchmarks/eyes.py PRETRAINED_MODEL DATASET, with a dataset from `manip-il data
redraw` that has another seed.
"""

import sys
from pathlib import Path

import numpy as np
import torch
from numpy.typing import NDArray

from manip_il.data.dataset import Dataset
from manip_il.data.schema import ENVIRONMENT_STATE, IMAGES, STATE
from manip_il.learn.cnn import CNNPolicy

FRAMES = 2_000
Batch = dict[str, torch.Tensor]


def batch_of(root: Path, cameras: tuple[str, ...], rows: NDArray[np.int64]) -> Batch:
    """Return frames of a dataset as inputs for a policy."""
    keys, dataset = [IMAGES + camera for camera in cameras], Dataset.open(root)
    frames = {key: dataset.camera(key).rows(rows).transpose(0, 3, 1, 2) for key in keys}
    table = dataset.columns([STATE, ENVIRONMENT_STATE])
    numbers = {key: torch.from_numpy(np.array(column[rows])) for key, column in table.items()}
    return numbers | {key: torch.from_numpy(frames[key]).float() / 255 for key in keys}


def read_off(policy: CNNPolicy, batch: Batch) -> torch.Tensor:
    """Return `observation.environment_state` as predicted from pictures and joints, (B, k), in
    its own units.
    """
    found, moves = policy.network_inputs(batch)[:, policy.seen_size :], policy.truth_scale > 0
    return policy.truth_mean + torch.where(moves, found / policy.truth_scale.clamp(min=1e-12), 0.0)


def report(policy: CNNPolicy, batch: Batch, names: tuple[str, ...]) -> None:
    """Print the median error of every predicted position [mm] and yaw [mrad]."""
    with torch.no_grad():
        found = torch.cat(
            [
                read_off(policy, {k: v[i : i + 50] for k, v in batch.items()})
                for i in range(0, FRAMES, 50)
            ]
        )
    truth, found = batch[ENVIRONMENT_STATE][: len(found)].double().numpy(), found.double().numpy()
    for name in names:
        first = names.index(name)
        if name.endswith(".x") and "axis" not in name:
            off = np.linalg.norm((found - truth)[:, first : first + 3], axis=1) * 1e3
            print(
                f"{name.removesuffix('.x'):20} {np.median(off):6.1f} mm, nine of ten within"
                f" {np.quantile(off, 0.9):.1f}"
            )
        if name.endswith(".cos4yaw"):
            yaw = [np.arctan2(one[:, first + 1], one[:, first]) / 4 for one in (found, truth)]
            off = np.abs((yaw[0] - yaw[1] + np.pi / 4) % (np.pi / 2) - np.pi / 4) * 1e3
            print(
                f"{name:20} {np.median(off):6.1f} mrad, nine of ten within"
                f" {np.quantile(off, 0.9):.1f}"
            )


def main() -> None:
    if len(sys.argv) < 3:
        print(__doc__)
        return
    policy, root = CNNPolicy.from_pretrained(sys.argv[1]).eval(), Path(sys.argv[2])
    spec = Dataset.open(root).spec
    count = len(Dataset.open(root).columns([STATE])[STATE])
    rows = np.sort(np.random.default_rng(1).choice(count, min(FRAMES, count), replace=False))
    batch = batch_of(root, spec.cameras, rows)
    report(policy, batch, spec.environment_state_names)


if __name__ == "__main__":
    main()
