"""LeRobot v3.0 datasets: everything that reads and writes them, under one name."""

from manip_il.data.lerobot_read import (
    DatasetInfo,
    camera_keys,
    dataset_info,
    read_episodes,
    read_fingerprint,
    read_provenance,
    read_spec,
    read_table,
)
from manip_il.data.lerobot_write import merge_datasets, write_dataset

__all__ = [
    "DatasetInfo",
    "camera_keys",
    "dataset_info",
    "merge_datasets",
    "read_episodes",
    "read_fingerprint",
    "read_provenance",
    "read_spec",
    "read_table",
    "write_dataset",
]
