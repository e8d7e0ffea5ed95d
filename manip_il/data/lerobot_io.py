"""LeRobot v3.0 datasets: everything that reads and writes them, under one name."""

from manip_il.data.lerobot_merge import merge_datasets
from manip_il.data.lerobot_read import (
    DatasetInfo,
    camera_keys,
    dataset_info,
    read_episodes,
    read_fingerprint,
    read_frames,
    read_provenance,
    read_spec,
    read_table,
    read_tables,
    video_rows,
)
from manip_il.data.lerobot_write import DatasetWriter, new_dataset, write_dataset
from manip_il.data.video import VideoConfig
from manip_il.data.video_read import count_frames

__all__ = [
    "DatasetInfo",
    "DatasetWriter",
    "VideoConfig",
    "camera_keys",
    "count_frames",
    "dataset_info",
    "merge_datasets",
    "new_dataset",
    "read_episodes",
    "read_fingerprint",
    "read_frames",
    "read_provenance",
    "read_spec",
    "read_table",
    "read_tables",
    "video_rows",
    "write_dataset",
]
