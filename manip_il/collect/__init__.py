"""The expert, the rollouts that it labels, and their recording.

- `expert.py` labels any state. `rollout.py` is the one loop that steps environments; `drivers.py` says who drives,
  `query.py` when the expert is queried and what it gives then.
- `job.py` is what a worker needs to turn seeds into episodes; `workers.py` runs jobs, `ray_pool.py` on a cluster, and
  `record.py` writes each episode to disk the moment it ends.
- `environments.py` makes environments and says what a dataset or policy must share with one.
- `edits.py` makes another dataset of a dataset's states: labels, pictures, or scenes (`scenes.py`) are made anew.
"""
