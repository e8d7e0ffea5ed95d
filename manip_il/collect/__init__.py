"""The expert, labelled rollouts, and their recording.

- `expert.py` labels any state. `rollout.py` is the only loop that steps environments; `drivers.py` defines who drives,
  `query.py` when the expert is queried and what it returns.
- `job.py` holds what a worker needs to turn seeds into episodes; `workers.py` runs jobs, `ray_pool.py` on a cluster,
  and `record.py` writes each episode to disk as soon as it ends.
- `environments.py` makes environments and their specs, which datasets and policies must share.
- `edits.py` makes a new dataset from a dataset's states, with new labels, pictures or scenes (`scenes.py`).
"""
