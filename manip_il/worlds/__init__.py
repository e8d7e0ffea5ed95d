"""Worlds: environments and experts, whoever made them, behind one contract.

- `contract.py` is what an environment, its spec and an expert are, and what a `WorldKind` makes
  from names.
- `table.py` lists the kinds by the robot's name and makes environments, experts, specs and
  fingerprints; `config.py` holds the settings of an environment.
- `ladder/` is our own kind and the default: `ManipEnv` and the expert that climbs a task's ladder.
  `gym/` is the kind of a class that describes an environment of gymnasium and its expert, the
  user's own or ours: `metaworld.py`, `fetch/` and `aloha/`, other packages' environments,
  unmodified. Nothing outside asks which one it has.
"""
