"""What of a policy is loaded only where the user trusts it: whatever fetches a model by name or brings code with it.

A checkpoint is data from anywhere. LeRobot's language and vision policies load tokenizers, encoders and whole models
that the checkpoint names, some with `trust_remote_code`, which runs Python from the named repository. Policies that
are built from their own configuration and weights alone are listed here, with the steps of their processors; all
others need `--trust=true`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from manip_il import checks
from manip_il.errors import ManipError
from manip_il.learn.pretrained import CONFIG, PROCESSORS, processor_steps

_NORMALISER = frozenset({"eps", "features", "norm_map", "normalize_observation_keys"})
_STEPS: dict[str, frozenset[str]] = {  # LeRobot's default processors: step -> the options that it may have
    "rename_observations_processor": frozenset({"rename_map"}),
    "to_batch_processor": frozenset(),
    "device_processor": frozenset({"device", "float_dtype"}),
    "normalizer_processor": _NORMALISER,
    "unnormalizer_processor": _NORMALISER,
}
PLAIN: dict[str, dict[str, frozenset[str]]] = {  # policies that load nothing by name -> their processors' steps
    name: _STEPS for name in ("act", "cnn", "diffusion", "gaussian_actor", "mlp", "tdmpc", "vqbet")
}
_NAMES: dict[str, tuple[str, ...]] = {  # other policies of LeRobot 0.6.1 -> the options that name what they load
    "eo1": ("vlm_base",),
    "evo1": ("vlm_model_name",),
    "fastwam": ("model_id", "base_model_id", "text_encoder_model_id", "tokenizer_model_id"),
    "gaussian_actor": ("vision_encoder_name",),  # plain without one
    "groot": ("base_model_path", "tokenizer_assets_repo"),
    "lingbot_va": ("wan_pretrained_path",),
    "molmoact2": ("checkpoint_path", "discrete_action_tokenizer"),
    "multi_task_dit": ("vision_encoder_name", "text_encoder_name"),
    "pi0_fast": ("text_tokenizer_name", "action_tokenizer_name"),
    "smolvla": ("vlm_model_name",),
    "vla_jepa": ("qwen_model_name", "jepa_encoder_name"),
    "wall_x": ("pretrained_name_or_path", "action_tokenizer_path"),
    "xvla": ("tokenizer_name",),
}


def require_trust(settings: Mapping[str, Any], where: str, trust: bool, folder: Path | None = None) -> None:
    """Raise `ManipError` unless a policy loads nothing by name, or `trust` is given; says what would be loaded.

    settings: its options with `type`, as `config.json` has them. where: whence they are, for the message. folder: a
    checkpoint, whose processors are looked at as well; of these, steps by import path are refused in any case.
    """
    kind = settings["type"]
    wanted = _models(kind, settings)
    for name in PROCESSORS if folder is not None else ():
        assert folder is not None
        wanted += _steps(name, processor_steps(folder / name), PLAIN.get(kind, _STEPS))
    if wanted and not trust:
        raise ManipError(
            f"{where} is a policy of type {kind!r} that would load {'; '.join(wanted)}: this fetches files and may run "
            "code that comes with them; if you trust its source, add --trust=true"
        )


def _models(kind: str, settings: Mapping[str, Any]) -> list[str]:
    """The models that a policy's options name."""
    named = {option: settings[option] for option in _NAMES.get(kind, ()) if settings.get(option) is not None}
    if named:
        return [_told(f"models by name ({CONFIG})", named)]
    return [] if kind in PLAIN else [f"models that LeRobot's {kind!r} names itself"]


def _steps(file: str, steps: Sequence[Mapping[str, Any]], allowed: Mapping[str, frozenset[str]]) -> list[str]:
    """The steps of a processor's file that are not allowed, or have options that are not."""
    found: list[str] = []
    for step in steps:
        name, options = step["registry_name"], step["config"]
        if name not in allowed:
            found.append(_told(f"the step {checks.shorten(name)} of {file}", options))
        elif extra := {key: options[key] for key in options if key not in allowed[name]}:
            found.append(_told(f"the step {name!r} of {file} with options of its own", extra))
    return found


def _told(what: str, options: Mapping[str, Any]) -> str:
    """With the options that say most, the names of models first."""
    named = sorted(options.items(), key=lambda item: not isinstance(item[1], str))[:3]
    told = ", ".join(f"{checks.shorten(key)[1:-1]}={checks.shorten(value)}" for key, value in named)
    return f"{what}: {told}" if told else what
