"""Targets of checkpoints: what LeRobot's layout and ours hold beside the weights, and the weights' header."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from manip_il.cli.inputs import check_policy, find_policy
from manip_il.collect.environments import env_fingerprint, env_spec, policy_sha256
from manip_il.learn.checkpoint import read_meta
from manip_il.learn.fit_config import FitConfig
from manip_il.learn.pretrained import read_interface
from manip_il.learn.train import fit
from manip_il.store.cards import card_for

from ..cli.made_runs import ENV, make_policy
from .binary import mutate_safetensors
from .target import Target, runs
from .trees import mutate_json, mutate_json_lines

ROWS = 40


def make_act(folder: Path) -> None:
    """`run/best/pretrained_model`: a small ACT."""
    make_policy(folder / "run" / "best" / "pretrained_model")


def make_mlp(folder: Path) -> None:
    """`run`: two steps of an mlp, with what resuming needs."""
    _fit(folder, resume=False)


def _fit(folder: Path, *, resume: bool, init_from: Path | None = None) -> None:
    spec, rng = env_spec(ENV), np.random.default_rng(0)
    state = rng.normal(size=(ROWS, len(spec.joint_names))).astype(np.float32)
    table = {
        "observation.state": state,
        "observation.environment_state": rng.normal(size=(ROWS, len(spec.environment_state_names))).astype(np.float32),
        "action": state + np.float32(0.01),
        "label_valid": np.ones((ROWS, 1), np.int64),
        "episode_index": np.repeat(np.arange(4), ROWS // 4),
        "frame_index": np.tile(np.arange(ROWS // 4), 4),
    }
    policy = {"width": 16, "depth": 1, "device": "cpu"}
    config = FitConfig(policy, steps=2, batch_size=8, log_freq=1, init_from=init_from)
    fit(table, config, folder / "run", spec=spec, fingerprint=env_fingerprint(ENV), resume=resume)


def _resume(folder: Path) -> None:
    _fit(folder, resume=True)


def _load(folder: Path) -> None:
    """What `eval` does with a policy before the first episode."""
    path = find_policy(folder / "run")
    check_policy(path, read_meta(path), ENV)


def _describe(folder: Path) -> None:
    path = find_policy(folder / "run")
    read_interface(path)
    policy_sha256(path)
    card_for(folder / "run", "policy", "hf://user/policy")


def _warm_start(folder: Path) -> None:
    _fit(folder / "warm", resume=False, init_from=folder / _MLP)


_ACT, _MLP = "run/best/pretrained_model", "run/checkpoints/000002/pretrained_model"
_STATE = "run/checkpoints/000002/training_state"
_READS = (_load, _load, _describe, runs("push", "{folder}/run", "file://{folder}/store"))
TARGETS = (
    Target("act config.json", make_act, f"{_ACT}/config.json", mutate_json, _READS, share=0.3),
    Target("act preprocessor", make_act, f"{_ACT}/policy_preprocessor.json", mutate_json, _READS, share=0.3),
    Target("act postprocessor", make_act, f"{_ACT}/policy_postprocessor.json", mutate_json, _READS, share=0.3),
    Target("act weights", make_act, f"{_ACT}/model.safetensors", mutate_safetensors, (_load,), share=0.3),
    Target("act statistics", make_act, f"{_ACT}/*processor_step*.safetensors", mutate_safetensors, (_load,), share=0.3),
    Target("act manip_il.json", make_act, f"{_ACT}/manip_il.json", mutate_json, _READS, share=0.3),
    Target("mlp config.json", make_mlp, f"{_MLP}/config.json", mutate_json, (*_READS, _resume)),
    Target("mlp manip_il.json", make_mlp, f"{_MLP}/manip_il.json", mutate_json, (*_READS, _resume)),
    Target("mlp preprocessor", make_mlp, f"{_MLP}/policy_preprocessor.json", mutate_json, _READS),
    Target("mlp weights", make_mlp, f"{_MLP}/model.safetensors", mutate_safetensors, (_load, _resume, _warm_start)),
    Target("training_step.json", make_mlp, f"{_STATE}/training_step.json", mutate_json, (_resume,)),
    Target("optimizer groups", make_mlp, f"{_STATE}/optimizer_param_groups.json", mutate_json, (_resume,)),
    Target("optimizer state", make_mlp, f"{_STATE}/optimizer_state.safetensors", mutate_safetensors, (_resume,)),
    Target("train metrics.jsonl", make_mlp, "run/metrics.jsonl", mutate_json_lines, (_resume,)),
)
