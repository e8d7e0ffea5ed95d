"""The sizes at which the tests run documented commands: every other word stays as it is written."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

import yaml

from manip_il.cli.main import load
from manip_il.cli.parsing import options_of
from manip_il.worlds.config import WORLDS

from .pages import command_of

Sizes = dict[str, Any]

SMALL: Sizes = {  # put into every command that has the option
    "dataset.num_episodes": 3,  # more frames than a chunk of ACT's
    "demonstrations": 2,
    "rounds": 1,
    "episodes_per_round": 2,
    "steps": 2,
    "batch_size": 8,
    "save_freq": 2,
    "validation_episodes": 1,
    "test_episodes": 1,
    "disturbed_episodes": 1,
    "eval.n_episodes": 2,
    "n_episodes": 1,
    "eval.films": 0,
    # a demonstration takes 40 steps; a policy that has learnt nothing takes all that it is given
    "env.horizon": 60,
    "training_seeds": 1,
    "cases": 1,
    "workers": 1,
}
# Only where the line gives the option.
GIVEN: Sizes = {"refit_steps": 1, "label_budget": 300, "replay": 4_000_001, "redraw": 30, "processes": 1,
                "dataset.episodes": "0:2",
                "image.height": 96, "image.width": 96}  # fmt: skip
OF_COMMAND: dict[str, Sizes] = {
    "dagger": {"image.height": 32, "image.width": 32},
    "robot check": {"episodes": 1},
    "theory": {"episodes": 2},
    "reward pairs": {"count": 12},
    "reward fit": {"members": 3},
    "rl gail": {"episodes": 2, "ppo.minibatches": 2, "ppo.epochs": 1, "discriminator.steps": 1},
    "rl airl": {"episodes": 2, "ppo.minibatches": 2, "ppo.epochs": 1, "discriminator.steps": 1},
    "rl ppo": {"episodes": 2, "episode_steps": 20, "ppo.minibatches": 2, "ppo.epochs": 1},
    # diffusion cuts out 84 x 84 pixels
    "data redraw": {"frames": 30, "image.height": 96, "image.width": 96},
    "view": {"output": "seen.rrd"},
}
OF_POLICY: dict[str, Sizes] = {
    "mlp": {"width": 16},
    "act": {"dim_model": 32, "n_heads": 2, "dim_feedforward": 32, "n_encoder_layers": 1},
    "diffusion": {"down_dims": "[16,32]", "n_groups": 4},
}
LEROBOT: dict[str, Sizes] = {
    "lerobot-train": {
        "steps": 2, "batch_size": 4, "num_workers": 0, "save_freq": 2, "log_freq": 1, "policy.device": "cpu",
    },
    "lerobot-eval": {"eval.n_episodes": 1, "eval.batch_size": 1, "eval.use_async_envs": "false"},
}  # fmt: skip
_SHORT = ("reach", "push")  # tasks of a study of many
LEROBOT_ENV: Sizes = {"env.episode_length": 5, "env.render_mode": "none"}
LEROBOT_EVALUATION: Sizes = {"eval.n_episodes": 1, "eval.batch_size": 1, "env_eval_freq": 2}


def small_words(words: Sequence[str]) -> list[str]:
    """The words behind `manip-il`, of a documented line, at a small size."""
    name, own = command_of(tuple(words))
    if "--help" in own:
        return list(words)
    known = {option.name for option in options_of(load(name)) if not option.positional}
    given = option_names(own)
    small = {
        option: size
        for option, size in SMALL.items()
        if option != "env.horizon" or not _is_stock(own)
    }
    sizes = {
        option: size
        for option, size in (small | OF_COMMAND.get(name, {})).items()
        if option in known
    }
    sizes |= {option: size for option, size in GIVEN.items() if option in given}
    if {"policy", "policy.width"} & known:
        kind = _value("policy.type", own) or _policy_in_config(own) or "mlp"
        sizes |= {f"policy.{option}": size for option, size in OF_POLICY.get(kind, {}).items()}
    if name == "compare" and own[0].endswith(".yaml"):  # the study's own file has its sizes
        sizes = {
            option: size
            for option, size in sizes.items()
            if not option.startswith(("eval.", "env."))
        }
    if name == "serve":  # it serves for as long as a program runs
        served = own[: own.index("--") if "--" in own else None]
        # nothing drives, so nothing is logged
        served = [word for word in served if not word.startswith("--log=")]
        return [name, *with_sizes(served, sizes), "--", "true"]
    return [*name.split(), *with_sizes(own, sizes)]


def small_lerobot(words: Sequence[str]) -> list[str]:
    """A line with one of LeRobot's commands, at a small size."""
    name, own = words[0], list(words[1:])
    sizes, given = dict(LEROBOT.get(name, {})), option_names(own)
    if "env.type" in given:
        sizes |= LEROBOT_ENV
    if "eval.n_episodes" in given:
        sizes |= LEROBOT_EVALUATION if name == "lerobot-train" else {}
    if name == "lerobot-train" and (kind := _value("policy.type", own)):
        sizes |= {f"policy.{option}": size for option, size in OF_POLICY.get(kind, {}).items()}
    if "resume" in given:  # two steps are done
        sizes |= {"steps": 4}
    return [name, *with_sizes(own, sizes)]


def with_sizes(words: Iterable[str], sizes: Mapping[str, Any]) -> list[str]:
    """These words with other values of these options, or with the options where they are
    missing.
    """
    kept: list[str] = []
    rest = list(words)
    while rest:
        word = rest.pop(0)
        if not word.startswith("--") or word[2:].partition("=")[0] not in sizes:
            kept.append(word)
        elif "=" not in word and rest and not rest[0].startswith("--"):
            rest.pop(0)
    return kept + [f"--{option}={size}" for option, size in sizes.items()]


def option_names(words: Iterable[str]) -> set[str]:
    """The options that these words give."""
    return {word[2:].partition("=")[0] for word in words if word.startswith("--")}


def _value(option: str, words: Iterable[str]) -> str:
    return next((word.partition("=")[2] for word in words if word.startswith(f"--{option}=")), "")


def _is_stock(words: Iterable[str]) -> bool:
    """Whether the environment is a stock one, whose horizon is fixed or what its expert needs."""
    return _value("robot.type", words) in WORLDS


def _policy_in_config(words: Iterable[str]) -> str:
    path = _value("config_path", words)
    tree = yaml.safe_load(Path(path).read_text(encoding="utf-8")) if path else {}
    return tree.get("policy", {}).get("type", "")


def shrink_study(path: Path) -> None:
    """Leave a study two of its arms, of small sizes, in place.

    All of them are read in `tests/cli/test_study.py`.
    """
    study = yaml.safe_load(path.read_text(encoding="utf-8"))
    of_dagger = {option.name for option in options_of(load("dagger"))}
    if any("task.type" in arm for arm in study["arms"].values()):  # of tasks that take so few steps
        study["arms"] = {name: study["arms"][name] for name in _SHORT}
    study["arms"] = dict(list(study["arms"].items())[:2])
    common = study["common"]
    for arm in (common, *study["arms"].values()):
        for option, size in (SMALL | GIVEN).items():
            if option in of_dagger and option in arm:
                arm[option] = size
    common |= {
        option: size
        for option, size in SMALL.items()
        if option in of_dagger and option != "workers"
    }
    policy = common.setdefault("policy", {})
    policy |= OF_POLICY.get(policy.get("type", "mlp"), {})
    if "image" in common:
        common["image"] = {"height": 32, "width": 32}
    study["eval"]["n_episodes"] = SMALL["eval.n_episodes"]
    path.write_text(yaml.safe_dump(study, sort_keys=False), encoding="utf-8")
