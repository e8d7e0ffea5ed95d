"""Datasets of several tasks of one robot as one dataset, as if they had been recorded together."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from manip_il.data import schema
from manip_il.data.dataset import Dataset, EpisodeData, Own
from manip_il.data.fingerprint import compare_fingerprints
from manip_il.data.lerobot_layout import Features
from manip_il.errors import MismatchError, warn
from manip_il.mdp import KEYPOINTS, State
from manip_il.worlds.contract import EnvironmentSpec
from manip_il.worlds.several import SeveralTasks, Tasks
from manip_il.worlds.table import env_fingerprint, stored_config, world_of

_SAME = ("cameras", "image_size", "video")


@dataclass(frozen=True)
class JoinedTasks:
    """Datasets of ours with different tasks.

    Attributes:
        datasets: The datasets, of one task each.
        tasks: Their tasks as one world.
        own: What `meta/manip_il.json` says of the joined dataset.
        features: Its columns.
    """

    datasets: Sequence[Dataset]
    tasks: Tasks
    own: Own
    features: Features

    @classmethod
    def of(cls, datasets: Sequence[Dataset], provenance: Mapping[str, Any]) -> JoinedTasks | None:
        """Return the datasets joined; None if they have the same task, or are not all ours.

        Args:
            datasets: The datasets.
            provenance: Origin of the joined one.

        Raises:
            MismatchError: if more than the task differs.
        """
        if not all(one.own for one in datasets):
            return None
        specs = [one.spec for one in datasets]
        names = tuple(dict.fromkeys(spec.task for spec in specs))
        if len(names) < 2:
            return None
        first = specs[0]
        for one, spec in zip(datasets, specs, strict=True):
            left = replace(first, environment_state_names=spec.environment_state_names)
            schema.check_same_spec(str(datasets[0].root), left, str(one.root), spec, _SAME)
        config = stored_config(replace(first, task=",".join(names)))
        kind = world_of(config.robot, config.task)
        if not isinstance(kind, SeveralTasks) or len(kind.names) > len(names):
            raise MismatchError("task", str(datasets[0].root), names[0], "the others", names[1:])
        tasks = kind.tasks(config)
        spec: EnvironmentSpec = replace(
            tasks.spec, cameras=first.cameras, image_size=first.image_size, video=first.video
        )
        for part in tasks.parts:
            here = env_fingerprint(part)
            del here["config_sha256"]  # the horizon is that of the longest task
            for one in datasets:
                there = {key: one.fingerprint[key] for key in here if key in one.fingerprint}
                if one.spec.task == part.task:
                    warn(*compare_fingerprints("this machine", here, str(one.root), there))
        look = {key: one for key, one in datasets[0].fingerprint.items() if "cameras" in key}
        sources = [{"name": one.root.name, "provenance": dict(one.provenance)} for one in datasets]
        own = Own(spec, env_fingerprint(config) | look, {**provenance, "merged": sources})
        ours = [schema.features(one) for one in specs]
        others = {
            key: feature
            for one, mine in zip(datasets, ours, strict=True)
            for key, feature in one.stored_features.items()
            if key not in mine
        }
        return cls(datasets, tasks, own, schema.features(spec) | others)

    def episodes(self) -> Iterator[EpisodeData]:
        """Yield the episodes of all datasets, in order, with the columns of the joined one."""
        names = [part.task for part in self.tasks.parts]
        for dataset in self.datasets:
            number = names.index(dataset.spec.task)
            for one in dataset.stored_episodes():
                columns = {
                    key: column
                    for key, column in one.columns.items()
                    if not key.startswith(KEYPOINTS)  # tasks have different points
                }
                yield replace(one, columns=columns | self._converted(number, columns))

    def _converted(self, number: int, columns: Mapping[str, Any]) -> dict[str, Any]:
        """Return the columns that differ between tasks, as all tasks have them."""
        tasks = self.tasks
        phases = np.asarray(columns[schema.EXPERT_PHASE])
        return {
            schema.ENVIRONMENT_STATE: np.stack(
                [tasks.united(number, row) for row in columns[schema.ENVIRONMENT_STATE]]
            ),
            schema.SIM_STATE: np.stack(
                [
                    tasks.packed(number, State.from_vector(row)).to_vector()
                    for row in columns[schema.SIM_STATE]
                ]
            ),
            schema.EXPERT_PHASE: np.asarray(tasks.phases[number], phases.dtype)[phases],
        }
