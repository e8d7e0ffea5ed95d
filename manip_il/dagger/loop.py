"""DAgger: roll out, ask the expert in every visited state, aggregate, refit; keep the best round.

Everything that a round makes lies in its folder and appears there whole, so that a run that was killed goes on
where it was: an episode, a fit's last checkpoint, or an evaluation that is there is not made again.
"""

from __future__ import annotations

import itertools
import logging
import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from manip_il.dagger.beta import BetaSchedule
from manip_il.dagger.collect import (
    MAX_TRIES,
    check_journals,
    collect,
    collect_successes,
    provenance,
    record,
)
from manip_il.dagger.config import DaggerConfig
from manip_il.dagger.dart import fitted_noise
from manip_il.dagger.fitting import branch_steps, check_labels, fit_round, resolved_ask, round_fit
from manip_il.data import schema
from manip_il.data.atomic import new_folder
from manip_il.data.build import Recording
from manip_il.data.journal import list_episodes, read_header
from manip_il.data.lerobot_io import dataset_info, merge_datasets, read_tables
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.errors import NothingToLearnError
from manip_il.evaluation.results import FILE_NAME, EvalResult
from manip_il.evaluation.runner import evaluate
from manip_il.mdp import Episode
from manip_il.seeding import stream_seeds
from manip_il.sim.disturb import STANDARD

_LOG = logging.getLogger(__name__)
BEST, DATASET, POLICY, HELD_OUT = "best", "dataset", "policy", "held_out"
HELD_OUT_EPISODES = 10  # of the expert's, on which `dart` measures the learner's errors


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
    on_episode: Callable[[Episode], None] = lambda episode: None
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
        last = round_ == config.rounds or _left(config, result.labels) == 0
        if last:
            _finish(config, folder, results)
        yield result
        if last:
            return


def best_round(results: list[RoundResult]) -> RoundResult:
    """The highest validation success; of equals the later, which has seen more."""
    return max(results, key=lambda result: (result.validation.success.rate, result.round))


def round_folder(folder: Path, round_: int) -> Path:
    """Where a round keeps its journals, dataset, checkpoint and evaluation."""
    return folder / f"round_{round_:03d}"


def datasets(folder: Path, rounds: int) -> list[Path]:
    """Those of rounds 0 to `rounds`; a round in which nobody was asked has none."""
    roots = (round_folder(folder, i) / DATASET for i in range(rounds + 1))
    return [root for root in roots if root.is_dir()]


def _run_round(
    config: DaggerConfig, folder: Path, engine: Engine, watch: Watch, round_: int, results: Sequence[RoundResult]
) -> RoundResult:
    here, previous = round_folder(folder, round_), results[-1] if results else None
    clock = {"collect": -time.monotonic()}
    _collect_round(config, folder, engine, watch, round_, previous)
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
        labels=_labels(datasets(folder, round_)),
        queries=(previous.queries if previous else 0) + _queries(config, folder, round_),
        episodes=(previous.episodes if previous else 0) + len(headers),
        rollout_success=sum(header.success for header in headers) / len(headers),
        policy=policy,
        validation=validation,
        seconds={stage: round(seconds, 2) for stage, seconds in clock.items()},
    )


def _collect_round(
    config: DaggerConfig, folder: Path, engine: Engine, watch: Watch, round_: int, previous: RoundResult | None
) -> None:
    """Round 0 and `cloning`: successful demonstrations. Later: every rollout, successful or not."""
    here = round_folder(folder, round_)
    if (here / DATASET).is_dir():
        return
    journals, repo_id = here / "journals", f"local/{config.env.robot}_{config.env.task}_round_{round_}"
    left = _left(config, previous.labels if previous else 0)
    count = config.demonstrations if previous is None else config.episodes_per_round
    watch.on_stage("collect", round_, count)
    if previous is None or config.method == "cloning":
        job = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold, round=round_, cameras=config.cameras)
        recording = Recording(repo_id, True, count, provenance(job), labels=left)
        stream = "demonstrations" if previous is None else f"round/{round_}"
        seeds = stream_seeds(stream, MAX_TRIES * count, config.seed)
        episodes = collect_successes(engine, job, seeds, count, journals, watch.on_episode)
    else:
        job = _round_job(config, folder, engine, round_, previous.policy)
        gated = job.labels != "per_state" or job.ask.kind != "every"
        recording = Recording(repo_id, provenance=provenance(job), only_labelled=gated, labels=left)
        seeds = stream_seeds(f"round/{round_}", count, config.seed)
        disturbed = round(config.disturbed_share * count) if config.method == "dagger" else 0
        episodes = itertools.chain(
            collect(engine, replace(job, disturbance=STANDARD), seeds[:disturbed], journals, watch.on_episode),
            collect(engine, job, seeds[disturbed:], journals, watch.on_episode),
        )
    for line in check_journals(journals, job):
        _LOG.warning("%s", line)
    try:
        record(episodes, journals, here / DATASET, job, recording)
    except NothingToLearnError:
        _LOG.warning("round %d: %d rollouts, and in none of them was the expert asked", round_, count)


def _round_job(config: DaggerConfig, folder: Path, engine: Engine, round_: int, policy: Path) -> RolloutJob:
    """The rollouts of a round after the demonstrations."""
    common = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold, round=round_, cameras=config.cameras)
    if config.method == "dart":
        held_out = _held_out(config, folder, engine)
        return replace(common, driver="noisy_expert", noise=fitted_noise(policy, held_out))
    beta = BetaSchedule.parse(config.beta).at(round_)
    return replace(
        common,
        driver="mixture" if beta > 0 else "policy",
        policy=policy,
        ensemble=tuple(_member(round_folder(folder, round_ - 1), i) for i in range(1, config.ensemble)),
        beta=beta,
        labels=config.label,
        ask=resolved_ask(config),
        branch_steps=branch_steps(config),
    )


def _held_out(config: DaggerConfig, folder: Path, engine: Engine) -> Path:
    """Demonstrations that no policy learns from."""
    root = folder / HELD_OUT / DATASET
    if not root.is_dir():
        job = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold)
        journals = folder / HELD_OUT / "journals"
        seeds = stream_seeds("held_out", HELD_OUT_EPISODES, config.seed)
        episodes = collect(engine, job, seeds, journals)
        record(episodes, journals, root, job, Recording("local/held_out", provenance=provenance(job)))
    return root


def _fit_round(config: DaggerConfig, folder: Path, watch: Watch, round_: int) -> Path:
    """Fit the policy, and the others of an ensemble after it; the policy's checkpoint."""
    here, before = round_folder(folder, round_), round_folder(folder, round_ - 1)
    warm = round_ > 0 and config.refit == "warm"
    paths: list[Path] = []
    for member in range(config.ensemble):
        name = "fit" if config.ensemble == 1 else f"fit {member + 1} of {config.ensemble}"
        watch.on_stage(name, round_, round_fit(config, warm).total_steps)
        start = _member(before, member) if warm else None
        into = here / _policy_name(member)
        paths.append(fit_round(config, datasets(folder, round_), into, start, watch.on_log, member))
    return paths[0]


def _policy_name(member: int) -> str:
    return POLICY if member == 0 else f"{POLICY}_{member}"


def _member(here: Path, member: int) -> Path:
    """The checkpoint of one of a round's policies."""
    return here / _policy_name(member) / "checkpoints" / "last" / "pretrained_model"


def _left(config: DaggerConfig, labels: int) -> int | None:
    """Labels that may still be had; None where there is no limit."""
    return None if config.label_budget is None else max(0, config.label_budget - labels)


def _queries(config: DaggerConfig, folder: Path, round_: int) -> int:
    """How often the expert was asked in a round."""
    here = round_folder(folder, round_)
    ask = resolved_ask(config).kind
    if config.method == "dagger" and round_ > 0 and (config.label != "per_state" or ask not in ("every", "safety")):
        return _labels([here / DATASET]) if (here / DATASET).is_dir() else 0
    folders = [here, folder / HELD_OUT] if config.method == "dart" and round_ == 1 else [here]
    return sum(read_header(path).frames for one in folders for path in list_episodes(one / "journals"))


def _labels(roots: Sequence[Path]) -> int:
    """Sound labels in datasets."""
    return int(read_tables(roots, (schema.LABEL_VALID,))[schema.LABEL_VALID].sum())


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
    rounds = datasets(folder, results[-1].round)
    episodes = sum(dataset_info(root).episodes for root in rounds)
    if (folder / DATASET).is_dir() and dataset_info(folder / DATASET).episodes == episodes:
        return
    shutil.rmtree(folder / DATASET, ignore_errors=True)
    name = f"local/{config.env.robot}_{config.env.task}_dagger"
    merge_datasets(rounds, folder / DATASET, repo_id=name, provenance={"best_round": best.round})
