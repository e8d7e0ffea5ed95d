"""Episodes on disk: the columns of a dataset, journals, and LeRobot v3.0 datasets.

`schema.py` is the one list of columns, and `RobotTaskSpec` the names, sizes and rate that a dataset, a policy and an
environment must share. `episodes.py` turns transitions into an `Episode` with these columns, and selects the episodes
that a dataset takes of rollouts.

`journal.py` writes one MCAP file for every finished episode, at once: a journal. `build.py` makes a dataset of a folder
of journals, or one dataset of several. `lerobot_write.py` writes datasets episode by episode with pyarrow and PyAV;
`lerobot_read.py` reads them as numpy arrays; `lerobot_library.py` is LeRobot's own writer, and its
metadata for policies. Around them: LeRobot's paths and types (`lerobot_layout.py`), statistics (`lerobot_stats.py`),
parquet (`parquet_files.py`, `parquet_limits.py`, `picture_columns.py`), videos (`video.py` writes, `pictures.py`
reads, and nothing else opens a picture), and pictures for training (`frame_source.py`): in a cache (`frame_cache.py`),
or decoded when they are drawn (`lazy_frames.py`).

What the room promises:

- A kill loses nothing that was finished. Files and folders appear whole or not at all (`atomic.py`); a killed recording
  loses at most the episodes that were running.
- Equal bytes. The same episodes in the same order give the same journals and the same dataset, videos included, whether
  it is written while episodes come or built from their journals later. `fingerprint.py` says when two environments
  promise equal episodes.
- Everything read is checked. Datasets may come from anyone: names never lead out of their folder, sizes are bounded
  before anything is unpacked, and whatever is wrong is one `ManipError` that names the file. So it is with a journal,
  whose checksums are compared before it is taken apart; its size is bounded when it is written.
"""
