"""Episodes on disk: the columns of a dataset, journals, and LeRobot v3.0 datasets.

`schema.py` is the one list of columns, and `RobotTaskSpec` the names, sizes and rate that a dataset, a policy and an
environment must share. `episodes.py` turns transitions into an `Episode` with these columns.

`journal.py` writes one MCAP file for every finished episode, at once: a journal. `lerobot_write.py` writes datasets
episode by episode with pyarrow and PyAV. `build.py` makes a dataset of rollouts (as they come, or of a folder of
journals), one of several datasets, or one with other numbers in some of its columns. `dataset.py` opens any LeRobot
dataset: `info.py` and `parquet_files.py` parse its `meta/` and its columns, `camera.py` finds and decodes its pictures,
`statistics.py` has its statistics.
Around them: LeRobot's paths and Arrow types (`lerobot_layout.py`), several as one for its policies (`joined.py`),
films (`video.py` writes them). `gate.py` tries in a child process what arrives from outside.

What the room promises:

- A kill loses nothing that was finished. Files and folders appear whole or not at all (`atomic.py`); a killed recording
  loses at most the episodes that were running.
- Equal bytes. The same episodes in the same order give the same journals and the same dataset, videos included, whether
  it is written while episodes come or built from their journals later. `fingerprint.py` says when two environments
  promise equal episodes.
- What arrives passes the gate: each file is opened once with bounded memory and time. Names never lead out of their
  folder. Code from outside never runs. A file that cannot be read is one `ManipError` that names it, with the reason of
  the library that read it (`info.reading`).
"""
