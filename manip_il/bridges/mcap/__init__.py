"""Export LeRobot v3.0 datasets as MCAP files, and import MCAP files as datasets.

- Export is lossless, and so is import with the `mapping.yaml` of an export, except for pictures
  that a mapping encodes as video. The same dataset gives the same files, byte for byte; the same
  files give the same dataset.
- On import, a gap beyond a topic's tolerance, a missing field, a value that the column's dtype
  cannot hold, and NaN are errors that name file and topic. Messages out of order are sorted; if
  stamps are equal, the last message counts. A dataset appears complete or not at all.
- Every file is first read in a child process with limited memory and time. Messages are protobuf,
  JSON or, with the package mcap-ros2-support, ROS 2 (cdr); chunks are zstd, lz4 or uncompressed.

`export` writes the channels of `data.foxglove`. `importing` reads and resamples messages, with a
`mapping` of columns to topics and fields.
"""
