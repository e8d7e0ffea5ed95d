"""Examine any folder of a LeRobot v3.0 dataset, and repair what can be repaired.

- `examine.examine` only reads. `repair` is the one function that writes: it builds a dataset again from its journals,
  or else computes statistics and moves leftovers away, in the dataset's folder and beside it, but not through links. It
  deletes nothing: what it replaces or moves is kept in `DATASET.before-repair`.
- No content of a folder ends the examination: a file that cannot be read is a finding, and so is a check that fails;
  all other files and checks are still examined. Every file is opened in a child process first (`data.gate`).
- Every finding is one printable line: error or warning, the file (and column), what is wrong and what to do. An error
  is wrong data, or data that LeRobot cannot read; a warning is everything else that a user should know.

Everything is examined: `meta/info.json`, tasks, the list of episodes, parquet files and their columns, every row's
index columns and numbers, `meta/stats.json`, every video frame and picture, leftovers of killed programs, journals
beside the dataset, and, in datasets of this program, the spec and the fingerprint.

The doctor shares what reads files (`data.parquet_files`, `data.info`, `data.episode_table`) with `data.dataset`, but
not that class itself: it stops at the first damage, the doctor reads on.

`examine.py` is the list of checks and the repair, `patient.py` what all checks read, `scan.py` the one pass over the
data files, `finding.py` what is reported; the other files are the checks.
"""
