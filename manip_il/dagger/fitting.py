"""One round's fit: a policy of any kind to the labels of all rounds so far."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from manip_il.dagger import sampling
from manip_il.dagger.config import DaggerConfig
from manip_il.data import schema
from manip_il.data.lerobot_io import read_tables
from manip_il.engine.ask import Ask
from manip_il.engine.choose import step_scale
from manip_il.engine.describe import env_fingerprint, env_spec
from manip_il.errors import UsageError
from manip_il.learn.fit_config import FitConfig
from manip_il.seeding import stream_base
from manip_il.sim.robot import get_robot

Table = dict[str, NDArray[Any]]
OnLog = Callable[[dict[str, Any]], None]
LEARNING_COLUMNS = (schema.STATE, schema.ENVIRONMENT_STATE, schema.ACTION, schema.LABEL_VALID, "episode_index")
CHUNK_STEPS = 20_000  # of a round, for policies other than the mlp, where none are given


def fit_round(
    config: DaggerConfig,
    roots: Sequence[Path],
    folder: Path,
    init_from: Path | None = None,
    on_log: OnLog | None = None,
    member: int = 0,
) -> Path:
    """Fit, or go on with fitting, a policy to datasets; the checkpoint's `pretrained_model`.

    init_from: start there (see `refit`). on_log: sees the metrics, {} at a step without. member: of the ensemble,
    each from a seed of its own.
    """
    fit, seed = round_fit(config, init_from is not None), stream_base("training", config.seed) + member
    if fit.is_mlp:
        table = read_tables(roots, LEARNING_COLUMNS)
        return fit_table(config, table, folder, init_from, on_log, seed, frame_weights(config, roots))
    from manip_il.learn.checkpoint import CheckpointMeta  # torch stays out of what only rolls out
    from manip_il.learn.fit_policy import fit_policy

    wanted = fit.other(seed, init_from)
    spec, fingerprint = env_spec(config.env, config.cameras), env_fingerprint(config.env, config.cameras)
    look = asdict(config.cameras.look) if config.cameras is not None else None
    options = wanted.what_changes_the_weights()
    return fit_policy(
        roots,
        wanted,
        folder,
        meta=CheckpointMeta.of(spec, fingerprint, options, wanted.observation, look),
        on_step=on_log,
        resume=True,
        weights=frame_weights(config, roots),
    )


def fit_table(
    config: DaggerConfig,
    table: Table,
    folder: Path,
    init_from: Path | None = None,
    on_log: OnLog | None = None,
    seed: int | None = None,
    weights: NDArray[np.float64] | None = None,
) -> Path:
    """Fit an mlp to `LEARNING_COLUMNS`, as every round's is fitted."""
    from manip_il.learn.train import fit

    return fit(
        table,
        round_fit(config, init_from is not None).mlp(
            stream_base("training", config.seed) if seed is None else seed, init_from
        ),
        folder,
        spec=env_spec(config.env),
        fingerprint=env_fingerprint(config.env),
        on_log=on_log,
        resume=True,
        weights=weights,
    )


def round_fit(config: DaggerConfig, warm: bool) -> FitConfig:
    """What one round's fit is made of."""
    fit = config.fit
    if fit.steps is None and not fit.is_mlp:
        fit = replace(fit, steps=CHUNK_STEPS)
    return replace(fit, steps=config.refit_steps) if warm and config.refit_steps is not None else fit


def frame_weights(config: DaggerConfig, roots: Sequence[Path]) -> NDArray[np.float64] | None:
    """How often each frame of the datasets is drawn; None where all are alike."""
    if config.sampling.is_even:
        return None
    return config.sampling.weights(read_tables(roots, sampling.COLUMNS), step_scale(get_robot(config.env.robot)))


def plan_length(fit: FitConfig) -> int:
    """Actions that the policy plans at once: 1 for one that maps a state to an action."""
    if fit.is_mlp:
        return 1
    indices = fit.other(0).policy.action_delta_indices
    return len(indices) if indices else 1


def branch_steps(config: DaggerConfig) -> int:
    """Of a branch: what was asked for, else as many as the policy can learn a whole plan from."""
    if config.branch_steps is not None:
        return config.branch_steps
    return plan_length(config.fit) + _left_out(config.fit)


def resolved_ask(config: DaggerConfig) -> Ask:
    """When the expert is asked, with the default of the label mode."""
    if config.ask is not None:
        return Ask.parse(config.ask)
    if config.label == "takeover":
        return Ask("one")
    return Ask("probability", 1 / branch_steps(config)) if config.label == "branch" else Ask()


def check_fit(config: DaggerConfig) -> None:
    """Raise `UsageError` unless the policy's own configuration takes what it is given."""
    config.fit.mlp(0) if config.fit.is_mlp else config.fit.other(0)


def check_labels(config: DaggerConfig) -> None:
    """Raise `UsageError` for labels that the policy cannot learn from, or a gate that it cannot answer."""
    ask, plan = resolved_ask(config), plan_length(config.fit)
    name = config.fit.policy.get("type", "mlp")
    if config.label == "per_state" and plan > 1 and ask.kind != "every":
        raise UsageError(
            f"ask={config.ask} with label=per_state yields single labels, and {name} learns from {plan} in a row; "
            "use label=branch or label=takeover"
        )
    if config.label == "branch" and branch_steps(config) <= _left_out(config.fit):
        raise UsageError(
            f"branch_steps is {branch_steps(config)}, but {name} leaves out the last {_left_out(config.fit)} frames of "
            "every episode; give more, or --policy.drop_n_last_frames=0"
        )
    if ask.kind == "likelihood":
        from manip_il.learn.policy import LIKELIHOODS

        if not config.fit.is_mlp or config.fit.policy.get("loss", "mse") not in LIKELIHOODS:
            raise UsageError(
                f"ask={config.ask} needs a policy with a likelihood: --policy.type=mlp with "
                f"--policy.loss={' or '.join(LIKELIHOODS)}"
            )


def _left_out(fit: FitConfig) -> int:
    """Frames at an episode's end that the policy does not learn from."""
    return 0 if fit.is_mlp else getattr(fit.other(0).policy, "drop_n_last_frames", 0)
