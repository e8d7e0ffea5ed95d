"""Export LeRobot v3.0 datasets as MCAP files, and import MCAP files as datasets.

- Numbers, text and pictures keep every bit on the way out, and by the `mapping.yaml` of an export also on the way back.
  Only pictures that a mapping encodes as video lose detail. The same dataset gives the same files, byte for byte.
- An import takes every value from a message that the mapping allows. It never extrapolates: a gap beyond a topic's
  tolerance, stamps that do not ascend, a missing field, a value that the column's dtype cannot hold, and NaN are errors
  that name file and topic. A dataset appears whole or not at all.
- A file is read once in a child process, with limits of memory and time, before it is imported. Messages are protobuf
  or JSON, chunks zstd, lz4 or uncompressed; other encodings (ROS) are refused.

`export` writes what `data.foxglove` encodes. `importing` resamples what `read` decodes, by a `mapping` of topics and of
`path`s to their fields.
"""
