"""Episodes on disk: columns, journals and LeRobot v3.0 datasets.

`schema.py` lists the columns; its `EnvironmentSpec` holds the names, sizes and rate that a dataset,
a policy and an environment must share. `episodes.py` turns transitions into an `Episode` with these
columns.

`journal.py` writes a journal, one MCAP file, as soon as an episode ends. `lerobot_write.py` writes
datasets episode by episode with pyarrow and PyAV: every dataset, whether recorded, built, merged,
edited or imported, is one call of `write_episodes` with other `EpisodeData`. `build.py` selects
episodes of rollouts (as they arrive, or from a folder of journals) and merges datasets.
`dataset.py` opens any LeRobot dataset, or several as one: `info.py` and `parquet_files.py` parse
its `meta/` and columns, `camera.py` decodes its pictures, `statistics.py` computes and reads
statistics. `lerobot_layout.py` has LeRobot's paths and Arrow types, `video.py` writes videos.
`gate.py` opens untrusted files in a child process.

Guarantees:

- A kill loses no finished work. Files and folders appear complete or not at all (`atomic.py`); a
  killed recording loses at most the running episodes.
- Equal bytes. The same episodes in the same order give the same journals and the same dataset,
  videos included, whether it is written while episodes arrive or built from their journals later.
  Environments with equal fingerprints (`fingerprint.py`) give equal episodes.
- Untrusted files pass through the gate: each is opened once with limited memory and time. Paths
  never lead outside their folder. Foreign code never runs. A file that cannot be read raises one
  `ManipError` that names it, with the reason given by the library (`info.reading`).
"""
