"""DAgger: roll out, ask the expert in every visited state, aggregate, refit; keep the best round.

Everything that a round makes lies in its folder and appears there whole, so that a run that was killed goes on
where it was: an episode, a fit's last checkpoint, or an evaluation that is there is not made again.
"""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.dagger.beta import BetaSchedule
from manip_il.dagger.config import DaggerConfig
from manip_il.dagger.fitting import check_labels, fit_round, round_fit
from manip_il.dagger.rounds import (
    DATASET,
    collect_round,
    count_labels,
    count_queries,
    datasets,
    episodes_of,
    labels_left,
    member_path,
    policy_name,
    round_folder,
)
from manip_il.data.atomic import new_folder
from manip_il.data.journal import list_episodes, read_header
from manip_il.data.lerobot_io import dataset_info, merge_datasets
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.evaluation.results import FILE_NAME, EpisodeResult, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds

BEST = "best"


@dataclass(frozen=True)
class RoundResult:
    """One finished round. policy: its checkpoint. Times in [s].

    labels: sound labels learnt from so far. queries: states in which the expert was asked so far, which is more where
    a gate has to know the answer to decide (`safety`, `dart`'s held-out episodes). episodes: rollouts so far.
    rollout_success: of this round's rollouts.
    """

    round: int
    beta: float
    labels: int
    queries: int
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
            "queries": self.queries,
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
    on_episode: Callable[[Episode | EpisodeResult], None] = lambda episode: None
    on_log: Callable[[dict[str, Any]], None] = lambda record: None  # {} at a step without metrics


def run_dagger(config: DaggerConfig, folder: Path, engine: Engine, watch: Watch | None = None) -> Iterator[RoundResult]:
    """Run, or go on with, the rounds in `folder`; yields each as it is done, the finished ones again first.

    When the last round is yielded, `best/pretrained_model` holds the round with the highest validation success
    (the later of equals) and `dataset` the aggregated LeRobot dataset. Raises `UsageError` for labels that the policy
    cannot learn from, before anything is run.
    """
    check_labels(config)
    watch = watch or Watch()
    results: list[RoundResult] = []
    for round_ in range(config.rounds + 1):
        result = _run_round(config, folder, engine, watch, round_, results)
        results.append(result)
        last = round_ == config.rounds or labels_left(config, result.labels) == 0
        if last:
            _finish(config, folder, results)
        yield result
        if last:
            return


def best_round(results: list[RoundResult]) -> RoundResult:
    """The highest validation success; of equals the later, which has seen more."""
    return max(results, key=lambda result: (result.validation.success.rate, result.round))


def _run_round(
    config: DaggerConfig, folder: Path, engine: Engine, watch: Watch, round_: int, results: Sequence[RoundResult]
) -> RoundResult:
    here, previous = round_folder(folder, round_), results[-1] if results else None
    clock = {"collect": -time.monotonic()}
    watch.on_stage("collect", round_, episodes_of(config, round_))
    left = labels_left(config, previous.labels if previous else 0)
    collect_round(config, folder, engine, round_, previous.policy if previous else None, left, watch.on_episode)
    clock["collect"] += time.monotonic()
    clock["fit"] = -time.monotonic()
    policy = _fit_round(config, folder, watch, round_)
    clock["fit"] += time.monotonic()
    clock["validate"] = -time.monotonic()
    watch.on_stage("validate", round_, config.validation_episodes)
    validation = _validate(config, here, engine, watch, policy, round_)
    clock["validate"] += time.monotonic()
    headers = [read_header(path) for path in list_episodes(here / "journals")]
    return RoundResult(
        round=round_,
        beta=BetaSchedule.parse(config.beta).at(round_) if config.method == "dagger" else 1.0,
        labels=count_labels(datasets(folder, round_)),
        queries=(previous.queries if previous else 0) + count_queries(config, folder, round_),
        episodes=(previous.episodes if previous else 0) + len(headers),
        rollout_success=sum(header.success for header in headers) / len(headers),
        policy=policy,
        validation=validation,
        seconds={stage: round(seconds, 2) for stage, seconds in clock.items()},
    )


def _fit_round(config: DaggerConfig, folder: Path, watch: Watch, round_: int) -> Path:
    """Fit the policy, and the others of an ensemble after it; the policy's checkpoint."""
    here, before = round_folder(folder, round_), round_folder(folder, round_ - 1)
    warm = round_ > 0 and config.refit == "warm"
    paths: list[Path] = []
    for member in range(config.ensemble):
        name = "fit" if config.ensemble == 1 else f"fit {member + 1} of {config.ensemble}"
        watch.on_stage(name, round_, round_fit(config, warm).total_steps)
        start = member_path(before, member) if warm else None
        into = here / policy_name(member)
        paths.append(fit_round(config, datasets(folder, round_), into, start, watch.on_log, member))
    return paths[0]


def _validate(config: DaggerConfig, here: Path, engine: Engine, watch: Watch, policy: Path, round_: int) -> EvalResult:
    path = here / FILE_NAME
    if path.is_file():
        return EvalResult.read(path)
    job = RolloutJob(config.env, "policy", policy=policy, labels="last", hold=config.hold)  # solved is solved
    job = replace(job, trust=config.fit.trust)
    seeds = stream_seeds("validation", config.validation_episodes, config.seed)
    result = evaluate(engine, job, seeds, f"DAgger round {round_}", watch.on_episode)
    result.write(path)
    return result


def _finish(config: DaggerConfig, folder: Path, results: list[RoundResult]) -> None:
    best = best_round(results)
    shutil.rmtree(folder / BEST, ignore_errors=True)
    with new_folder(folder / BEST) as new:
        shutil.copytree(best.policy, new / "pretrained_model")
    rounds = datasets(folder, results[-1].round)
    episodes = sum(dataset_info(root).episodes for root in rounds)
    if (folder / DATASET).is_dir() and dataset_info(folder / DATASET).episodes == episodes:
        return
    shutil.rmtree(folder / DATASET, ignore_errors=True)
    name = f"local/{config.env.robot}_{config.env.task}_dagger"
    merge_datasets(rounds, folder / DATASET, repo_id=name, provenance={"best_round": best.round})
