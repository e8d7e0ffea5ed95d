"""DAgger: roll out, ask the expert in every visited state, aggregate, refit; keep the best round.

Everything that a round makes lies in its folder and appears there whole, so that a run that was killed goes on
where it was: an episode, a fit's last checkpoint, or an evaluation that is there is not made again.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.dagger.beta import BetaSchedule
from manip_il.dagger.collect import MAX_TRIES, check_journals, collect, collect_successes, provenance, record
from manip_il.dagger.config import DaggerConfig
from manip_il.data import schema
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording
from manip_il.data.lerobot_io import dataset_info, merge_datasets, read_table
from manip_il.engine.describe import env_fingerprint, env_spec
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.mdp import Episode
from manip_il.seeding import stream_base, stream_seeds
from manip_il.sim.disturb import STANDARD

_LOG = logging.getLogger(__name__)
Table = dict[str, NDArray[Any]]
BEST, DATASET = "best", "dataset"
LEARNING_COLUMNS = (schema.STATE, schema.ENVIRONMENT_STATE, schema.ACTION, schema.LABEL_VALID, "episode_index")


@dataclass(frozen=True)
class RoundResult:
    """One finished round. labels: expert labels learnt from so far; policy: its checkpoint. Times in [s]."""

    round: int
    beta: float
    labels: int
    episodes: int
    rollout_success: float
    policy: Path
    validation: EvalResult
    seconds: dict[str, float]

    def to_json(self) -> dict[str, Any]:
        """One line of `metrics.jsonl`."""
        success = self.validation.success
        return {
            "round": self.round,
            "beta": self.beta,
            "labels": self.labels,
            "episodes": self.episodes,
            "rollout_success": self.rollout_success,
            "validation_success": success.rate,
            "validation_interval": list(success.interval),
            "validation_episodes": success.n,
            "seconds": self.seconds,
        }


@dataclass(frozen=True)
class Watch:
    """What a caller sees of a run as it goes. Raising in any of them ends the run; what is on disk stays."""

    on_stage: Callable[[str, int, int], None] = lambda stage, round_, total: None
    on_episode: Callable[[Episode], None] = lambda episode: None
    on_log: Callable[[dict[str, Any]], None] = lambda record: None


def run_dagger(config: DaggerConfig, folder: Path, engine: Engine, watch: Watch | None = None) -> Iterator[RoundResult]:
    """Run, or go on with, the rounds in `folder`; yields each as it is done, the finished ones again first.

    When the last round is yielded, `best/pretrained_model` holds the round with the highest validation success
    (the later of equals) and `dataset` the aggregated LeRobot dataset.
    """
    watch = watch or Watch()
    results: list[RoundResult] = []
    for round_ in range(config.rounds + 1):
        previous = results[-1].policy if results else None
        result = _run_round(config, folder, engine, watch, round_, previous)
        results.append(result)
        if round_ == config.rounds:
            _finish(config, folder, results)
        yield result


def best_round(results: list[RoundResult]) -> RoundResult:
    """The highest validation success; of equals the later, which has seen more."""
    return max(results, key=lambda result: (result.validation.success.rate, result.round))


def round_folder(folder: Path, round_: int) -> Path:
    """Where a round keeps its journals, dataset, checkpoint and evaluation."""
    return folder / f"round_{round_:03d}"


def aggregate(folder: Path, rounds: int) -> Table:
    """D: the learning columns of rounds 0 to `rounds`, one after the other."""
    parts = [read_table(round_folder(folder, i) / DATASET, LEARNING_COLUMNS) for i in range(rounds + 1)]
    table = {key: np.concatenate([part[key] for part in parts]) for key in parts[0]}
    first = np.cumsum([0, *(int(part["episode_index"][-1]) + 1 for part in parts[:-1])])
    numbers = [part["episode_index"] + start for part, start in zip(parts, first, strict=True)]
    return table | {"episode_index": np.concatenate(numbers)}


def train_config(config: DaggerConfig, init_from: Path | None = None) -> Any:
    """The `TrainConfig` of one round's fit."""
    from manip_il.learn.mlp.configuration_mlp import MLPConfig
    from manip_il.learn.train import TrainConfig

    fit = config.fit
    return TrainConfig(
        steps=fit.steps,
        batch_size=fit.batch_size,
        threads=fit.threads,
        seed=stream_base("training", config.seed),
        init_from=init_from,
        policy=MLPConfig(loss=fit.loss, width=fit.width, depth=fit.depth),
    )


def fit_policy(
    config: DaggerConfig,
    table: Table,
    folder: Path,
    init_from: Path | None = None,
    on_log: Callable[[dict[str, Any]], None] | None = None,
) -> Path:
    """Fit, or go on with fitting, one policy; the checkpoint's `pretrained_model`."""
    from manip_il.learn.train import fit  # torch stays out of what only rolls out

    return fit(
        table,
        train_config(config, init_from),
        folder,
        spec=env_spec(config.env),
        fingerprint=env_fingerprint(config.env),
        on_log=on_log,
        resume=True,
    )


def _run_round(
    config: DaggerConfig, folder: Path, engine: Engine, watch: Watch, round_: int, previous: Path | None
) -> RoundResult:
    here, beta = round_folder(folder, round_), BetaSchedule.parse(config.beta).at(round_)
    clock = {"collect": -time.monotonic()}
    watch.on_stage("collect", round_, config.demonstrations if round_ == 0 else config.episodes_per_round)
    _collect_round(config, here, engine, watch, round_, beta, previous)
    clock["collect"] += time.monotonic()
    clock["fit"] = -time.monotonic()
    watch.on_stage("fit", round_, config.fit.steps)
    table = aggregate(folder, round_)
    policy = fit_policy(config, table, here / "policy", previous if config.refit == "warm" else None, watch.on_log)
    clock["fit"] += time.monotonic()
    clock["validate"] = -time.monotonic()
    watch.on_stage("validate", round_, config.validation_episodes)
    validation = _validate(config, here, engine, watch, policy, round_)
    clock["validate"] += time.monotonic()
    info = dataset_info(here / DATASET)
    return RoundResult(
        round=round_,
        beta=beta,
        labels=int(table[schema.LABEL_VALID].sum()),
        episodes=int(table["episode_index"][-1]) + 1,
        rollout_success=(info.success or 0) / info.episodes,
        policy=policy,
        validation=validation,
        seconds={stage: round(seconds, 2) for stage, seconds in clock.items()},
    )


def _collect_round(
    config: DaggerConfig, here: Path, engine: Engine, watch: Watch, round_: int, beta: float, previous: Path | None
) -> None:
    """Round 0: successful demonstrations. Later: every rollout of the mixture, successful or not."""
    if (here / DATASET).is_dir():
        return
    journals = here / "journals"
    repo_id = f"local/{config.env.robot}_{config.env.task}_round_{round_}"
    if previous is None:
        job = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold)
        recording = Recording(repo_id, True, config.demonstrations, provenance(job))
        seeds = stream_seeds("demonstrations", MAX_TRIES * config.demonstrations, config.seed)
        episodes = collect_successes(engine, job, seeds, config.demonstrations, journals, watch.on_episode)
    else:
        job = RolloutJob(config.env, "mixture", policy=previous, beta=beta, hold=config.hold, round=round_)
        recording = Recording(repo_id, provenance=provenance(job))
        seeds = stream_seeds(f"round/{round_}", config.episodes_per_round, config.seed)
        disturbed = round(config.disturbed_share * len(seeds))
        episodes = itertools.chain(
            collect(engine, replace(job, disturbance=STANDARD), seeds[:disturbed], journals, watch.on_episode),
            collect(engine, job, seeds[disturbed:], journals, watch.on_episode),
        )
    for line in check_journals(journals, job):
        _LOG.warning("%s", line)
    record(episodes, journals, here / DATASET, job, recording)


def _validate(config: DaggerConfig, here: Path, engine: Engine, watch: Watch, policy: Path, round_: int) -> EvalResult:
    path = here / FILE_NAME
    if path.is_file():
        return EvalResult.read(path)
    job = RolloutJob(config.env, "policy", policy=policy, labels="last")
    seeds = stream_seeds("validation", config.validation_episodes, config.seed)
    result = evaluate(engine, job, seeds, f"DAgger round {round_}", watch.on_episode)
    result.write(path)
    return result


def _finish(config: DaggerConfig, folder: Path, results: list[RoundResult]) -> None:
    best = best_round(results)
    shutil.rmtree(folder / BEST, ignore_errors=True)
    with new_folder(folder / BEST) as new:
        shutil.copytree(best.policy, new / "pretrained_model")
    if (folder / DATASET).is_dir() and dataset_info(folder / DATASET).episodes == results[-1].episodes:
        return
    shutil.rmtree(folder / DATASET, ignore_errors=True)
    rounds = [round_folder(folder, result.round) / DATASET for result in results]
    name = f"local/{config.env.robot}_{config.env.task}_dagger"
    merge_datasets(rounds, folder / DATASET, repo_id=name, provenance={"best_round": best.round})
