"""Labelled rollouts, and their recording.

- `rollout.py` is the only loop that steps environments; `drivers.py` defines who drives,
  `query.py` when the expert is queried and what it returns.
- `job.py` holds what a worker needs to turn seeds into episodes; `workers.py` runs jobs,
  `ray_pool.py` on a cluster, and `record.py` writes each episode to disk as soon as it ends.
- `edits.py` makes a new dataset from a dataset's states, with new labels, pictures or scenes.
"""
