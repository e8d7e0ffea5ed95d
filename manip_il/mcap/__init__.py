"""Export LeRobot v3.0 datasets as MCAP files, and import MCAP files as datasets.

- Numbers, text and pictures keep every bit on the way out, and by the `mapping.yaml` of an export also on the way back.
  Only pictures that a mapping encodes as video lose detail. The same dataset gives the same files, byte for byte, and
  the same files the same dataset.
- An import takes every value from a message that the mapping allows: a gap beyond a topic's tolerance, a missing field,
  a value that the column's dtype cannot hold, and NaN are errors that name file and topic. Messages out of order are
  sorted; of equal stamps the last one counts. A dataset appears whole or not at all.
- A file is read once in a child process, with limits of memory and time, before it is imported. Messages are protobuf,
  JSON or, with the package mcap-ros2-support, ROS 2 (cdr); chunks zstd, lz4 or uncompressed.

`export` writes what `data.foxglove` encodes. `importing` resamples what `read` decodes, by a `mapping` of topics and of
`path`s to their fields.
"""
