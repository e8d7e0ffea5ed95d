"""Seeds to success: run one policy on stored seeds and say how often it got there."""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence

import numpy as np

from manip_il.data import schema
from manip_il.engine.describe import env_fingerprint
from manip_il.engine.engine import Engine
from manip_il.engine.jobs import RolloutJob
from manip_il.engine.sight import drawn_cameras
from manip_il.evaluation.results import EpisodeResult, EvalResult, EvalSettings
from manip_il.mdp import Episode, Phase
from manip_il.sim.disturb import Disturbance

_LOG = logging.getLogger(__name__)


def evaluate(
    engine: Engine,
    job: RolloutJob,
    seeds: Sequence[int],
    name: str,
    on_episode: Callable[[Episode], None] | None = None,
) -> EvalResult:
    """Run `job` on every seed, to the horizon unless it has a `hold`; episodes are in the order of `seeds`.

    A seed that kills its worker again and again is left out, and a warning names it. on_episode: sees every episode
    with its states as it ends, to film it, say.
    """
    results: dict[int, EpisodeResult] = {}
    for episode in engine.run(job, seeds):
        results[episode.seed] = episode_result(episode)
        if on_episode is not None:
            on_episode(episode)
    if lost := [seed for seed in seeds if seed not in results]:
        _LOG.warning("left out of the evaluation, as each killed its worker again and again: seeds %s", lost)
    return EvalResult(
        policy=name,
        robot=job.env.robot,
        task=job.env.task,
        fingerprint=env_fingerprint(job.env, drawn_cameras(job)),
        episodes=tuple(results[seed] for seed in seeds if seed in results),
        settings=EvalSettings(job.env.horizon, job.env.tolerance, describe_disturbance(job.disturbance)),
    )


def episode_result(episode: Episode) -> EpisodeResult:
    """What an evaluation keeps of an episode."""
    solved = episode.columns[schema.SUCCESS].ravel()
    first = int(np.argmax(solved)) + 1 if solved.any() else None
    return EpisodeResult(
        seed=episode.seed,
        success=episode.success,
        success_at_end=episode.success_at_end,
        steps=len(episode),
        ret=float(episode.columns[schema.REWARD].sum()),
        phase_at_end=Phase(int(episode.columns[schema.EXPERT_PHASE].ravel()[-1])).name.lower(),
        detail={"steps_to_success": first},
    )


def describe_disturbance(disturbance: Disturbance) -> str:
    """In words, for tables and for `eval.json`."""
    parts: list[str] = []
    if disturbance.knock is not None:
        low, high = (100 * distance for distance in disturbance.knock)
        parts.append(f"object knocked {low:.0f} to {high:.0f} cm once")
    if disturbance.action_noise:
        parts.append(f"{disturbance.action_noise:.0%} action noise")
    return ", ".join(parts) or "none"
