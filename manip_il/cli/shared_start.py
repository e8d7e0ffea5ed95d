"""Arms of a study that differ only after round 0 share it: the same options and seed would give the same bytes."""

from __future__ import annotations

import json
import shutil
from collections.abc import Iterable
from dataclasses import fields

from manip_il.cli.dagger import METRICS_FILE, DaggerOptions
from manip_il.cli.folders import atomic_write, read_jsonl
from manip_il.cli.groups import save_options

ROUND_0 = "round_000"
# What round 0 does not depend on, which is demonstrations and the first fit
_LATER = (
    *("method", "rounds", "episodes_per_round", "disturbed_share", "beta", "label", "query", "branch_steps"),
    *("refit", "refit_steps", "output_dir", "resume", "overwrite", "workers", "engine"),
)


def same_start(left: DaggerOptions, right: DaggerOptions) -> bool:
    """Return whether two runs have the same round 0."""
    names = [one.name for one in fields(DaggerOptions) if one.name not in _LATER]
    return all(getattr(left, name) == getattr(right, name) for name in names)


def share_start(options: DaggerOptions, others: Iterable[DaggerOptions]) -> bool:
    """Begin a run that is not there yet with the round 0 of one that is; whether there was such a one.

    Its line of metrics comes along, so that the run is charged for what its round 0 took.
    """
    from manip_il.data.atomic import new_folder

    if options.output_dir.exists():
        return False
    for other in others:
        records = read_jsonl(other.output_dir / METRICS_FILE)
        if same_start(options, other) and records and (other.output_dir / ROUND_0).is_dir():
            with new_folder(options.output_dir) as folder:
                shutil.copytree(other.output_dir / ROUND_0, folder / ROUND_0, symlinks=True)
                atomic_write(folder / METRICS_FILE, json.dumps(records[0]) + "\n")
                save_options(folder, options)
            return True
    return False
