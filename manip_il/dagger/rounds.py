"""One round's rollouts and labels on disk: what is asked of whom, and where it lies.

round_003/journals/    every rollout, the moment it ended
round_003/dataset/     what is learnt from; missing where nobody was asked
round_003/policy/      the fit; policy_1, ... of an ensemble
held_out/              the expert's demonstrations that no policy learns from (`dart`)
"""

from __future__ import annotations

import itertools
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from manip_il.dagger.beta import BetaSchedule
from manip_il.dagger.collect import (
    MAX_TRIES,
    OnEpisode,
    check_journals,
    collect,
    collect_successes,
    provenance,
    record,
)
from manip_il.dagger.config import DaggerConfig
from manip_il.dagger.dart import fitted_noise
from manip_il.dagger.fitting import branch_steps, resolved_ask
from manip_il.data import schema
from manip_il.data.build import Recording
from manip_il.data.journal import list_episodes, read_header
from manip_il.data.lerobot_io import read_tables
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.errors import NothingToLearnError
from manip_il.seeding import stream_seeds
from manip_il.sim.disturb import STANDARD

_LOG = logging.getLogger(__name__)
DATASET, POLICY, HELD_OUT = "dataset", "policy", "held_out"
HELD_OUT_EPISODES = 10  # of the expert's, on which `dart` measures the learner's errors


def round_folder(folder: Path, round_: int) -> Path:
    """Where a round keeps its journals, dataset, checkpoint and evaluation."""
    return folder / f"round_{round_:03d}"


def datasets(folder: Path, rounds: int) -> list[Path]:
    """Those of rounds 0 to `rounds`; a round in which nobody was asked has none."""
    roots = (round_folder(folder, i) / DATASET for i in range(rounds + 1))
    return [root for root in roots if root.is_dir()]


def episodes_of(config: DaggerConfig, round_: int) -> int:
    """Rollouts of a round."""
    return config.demonstrations if round_ == 0 else config.episodes_per_round


def collect_round(
    config: DaggerConfig,
    folder: Path,
    engine: Engine,
    round_: int,
    policy: Path | None,
    left: int | None,
    on_episode: OnEpisode | None = None,
) -> None:
    """Run, or go on with, a round's rollouts, and write its dataset, unless that is there.

    Round 0 and `cloning`: successful demonstrations. Later: every rollout, successful or not. policy: of the round
    before, None in round 0. left: labels that may still be had, None for any number.
    """
    here = round_folder(folder, round_)
    if (here / DATASET).is_dir():
        return
    journals, repo_id = here / "journals", f"local/{config.env.robot}_{config.env.task}_round_{round_}"
    count = episodes_of(config, round_)
    if policy is None or config.method == "cloning":
        job = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold, round=round_, cameras=config.cameras)
        recording = Recording(repo_id, True, count, provenance(job), labels=left)
        stream = "demonstrations" if policy is None else f"round/{round_}"
        seeds = stream_seeds(stream, MAX_TRIES * count, config.seed)
        episodes = collect_successes(engine, job, seeds, count, journals, on_episode)
    else:
        job = _round_job(config, folder, engine, round_, policy)
        gated = job.labels != "per_state" or job.ask.kind != "every"
        recording = Recording(repo_id, provenance=provenance(job), only_labelled=gated, labels=left)
        seeds = stream_seeds(f"round/{round_}", count, config.seed)
        disturbed = round(config.disturbed_share * count) if config.method == "dagger" else 0
        episodes = itertools.chain(
            collect(engine, replace(job, disturbance=STANDARD), seeds[:disturbed], journals, on_episode),
            collect(engine, job, seeds[disturbed:], journals, on_episode),
        )
    for line in check_journals(journals, job):
        _LOG.warning("%s", line)
    try:
        record(episodes, journals, here / DATASET, job, recording)
    except NothingToLearnError:
        _LOG.warning("round %d: %d rollouts, but the expert was asked in none of them", round_, count)


def _round_job(config: DaggerConfig, folder: Path, engine: Engine, round_: int, policy: Path) -> RolloutJob:
    """The rollouts of a round after the demonstrations."""
    common = RolloutJob(config.env, "expert", beta=1.0, hold=config.hold, round=round_, cameras=config.cameras)
    if config.method == "dart":
        held_out = _held_out(config, folder, engine)
        return replace(common, driver="noisy_expert", noise=fitted_noise(policy, held_out, trust=config.fit.trust))
    beta = BetaSchedule.parse(config.beta).at(round_)
    return replace(
        common,
        driver="mixture" if beta > 0 else "policy",
        policy=policy,
        ensemble=tuple(member_path(round_folder(folder, round_ - 1), i) for i in range(1, config.ensemble)),
        beta=beta,
        labels=config.label,
        ask=resolved_ask(config),
        branch_steps=branch_steps(config),
        trust=config.fit.trust,
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


def policy_name(member: int) -> str:
    """The folder of one of a round's policies."""
    return POLICY if member == 0 else f"{POLICY}_{member}"


def member_path(here: Path, member: int) -> Path:
    """The checkpoint of one of a round's policies."""
    return here / policy_name(member) / "checkpoints" / "last" / "pretrained_model"


def labels_left(config: DaggerConfig, labels: int) -> int | None:
    """Labels that may still be had; None where there is no limit."""
    return None if config.label_budget is None else max(0, config.label_budget - labels)


def count_queries(config: DaggerConfig, folder: Path, round_: int) -> int:
    """How often the expert was asked in a round."""
    here = round_folder(folder, round_)
    ask = resolved_ask(config).kind
    if config.method == "dagger" and round_ > 0 and (config.label != "per_state" or ask not in ("every", "safety")):
        return count_labels([here / DATASET]) if (here / DATASET).is_dir() else 0
    folders = [here, folder / HELD_OUT] if config.method == "dart" and round_ == 1 else [here]
    return sum(read_header(path).frames for one in folders for path in list_episodes(one / "journals"))


def count_labels(roots: Sequence[Path]) -> int:
    """Sound labels in datasets."""
    return int(read_tables(roots, (schema.LABEL_VALID,))[schema.LABEL_VALID].sum())
