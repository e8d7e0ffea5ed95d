"""Export LeRobot v3.0 datasets as MCAP files, and import MCAP files as datasets.

- Numbers, text and pictures keep every bit on the way out, and by the `mapping.yaml` of an export also on the way back.
  Only pictures that a mapping encodes as video lose detail. The same dataset gives the same files, byte for byte.
- An import takes every value from a message that the mapping allows. It never extrapolates: a gap beyond a topic's
  tolerance, stamps that do not ascend, a missing field, a value that the column's dtype cannot hold, and NaN are errors
  that name file, topic and time. A dataset appears whole or not at all.
- A foreign file is hostile until checked: all checksums that it has are compared, sizes are limited before anything is
  unpacked (a chunk to 128 MiB, a message to 64 MiB, a file to 2 GiB or 1000 times its size; see `records` and `read`),
  and pictures are decoded by Foxglove's published schemas, whatever schema the file declares. Messages are read in
  protobuf and JSON, chunks in zstd, lz4 or uncompressed; other encodings (ROS) are refused.

`export` writes what `foxglove` encodes. `importing` resamples what `read` decodes from `records`, by a `mapping` of
topics and field `path`s. Journals (`data.journal`) are MCAP files of the same channels and limits.
"""
