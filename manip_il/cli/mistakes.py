"""What a mistyped option may have meant, for the error message."""

from __future__ import annotations

import typing
from collections.abc import Iterable, Mapping
from difflib import SequenceMatcher
from pathlib import Path
from typing import TYPE_CHECKING

from manip_il.errors import UsageError, did_you_mean, shorten

if TYPE_CHECKING:
    from manip_il.cli.options import Option

_FEW = 3
_NEAR = 0.65  # ratio of difflib from which on a name is offered
_AS_NEAR = 0.1  # of the best one: others that are offered beside it
_LONGEST = 100  # [characters] of a name that is compared


def unknown_option(kind: str, name: str, known: Mapping[str, Option], dashes: str, command: str) -> UsageError:
    """Return the error for an option or a key that is not there: the nearest few, and what lists all.

    kind: `option`, or which file's key. dashes: what stands before the names. command: empty where no one is known.
    """
    if name in known and known[name].is_open:
        return UsageError(f"{dashes}{name} is a group of options; expected {dashes}{name}.NAME=VALUE")
    inside = [option for option in known if option.startswith(f"{name}.")]
    if inside:
        return UsageError(f"{dashes}{name} is a group of options; known: {', '.join(dashes + one for one in inside)}")
    named = [one.name for one in known.values() if not (dashes and one.positional) and not one.is_open]
    near = did_you_mean([dashes + one for one in nearest_options(name, named)])
    return UsageError(f"unknown {kind} {shorten(dashes + name)}{near}; {_help(command)} lists all")


def unexpected_word(word: str, known: Mapping[str, Option], command: str) -> UsageError:
    """Return the error for a word that is neither an option nor a value: how it may have been meant."""
    text = f"unexpected {shorten(word)}"
    name = word.lstrip("-").partition("=")[0]
    if name in known or (word.startswith("-") and nearest_options(name, known)):
        return UsageError(f"{text}; options begin with two dashes: --{word.lstrip('-')}")
    if "=" in word:
        return unknown_option("option", name, known, "--", command)
    if word.endswith((".yaml", ".yml")):
        return UsageError(f"{text}; a file of options is given as --config_path={word}")
    paths = [one.name for one in known.values() if Path in _types(one.type) and one.name != "output_dir"]
    opens = [f"{one.name}.path" for one in known.values() if one.is_open and one.name == "policy"]
    if paths or opens:
        return UsageError(f"{text}; options are written --name=value (did you mean --{(paths or opens)[0]}={word}?)")
    return UsageError(f"{text}; options are written --name=value, and {_help(command)} lists them")


def nearest_options(name: str, known: Iterable[str]) -> list[str]:
    """Options that a name may have meant, the nearest first: `num_episodes` finds `dataset.num_episodes`."""
    scores = {option: _likeness(name[:_LONGEST].replace("-", "_"), option) for option in known}
    best = max(scores.values(), default=0.0)
    near = [option for option, score in scores.items() if score >= max(_NEAR, best - _AS_NEAR)]
    return sorted(near, key=lambda option: -scores[option])[:_FEW]


def _likeness(name: str, option: str) -> float:
    """From 0 to 2: of the last words of two dotted names, and of the whole; 1 and more where the last words agree."""
    leaf, other = name.rpartition(".")[2], option.rpartition(".")[2]
    whole = SequenceMatcher(None, name, option).ratio()
    if leaf == other:
        return 1 + whole
    if len(leaf) >= 3 and (other.startswith(leaf) or leaf.startswith(f"{other}_")):
        return max(0.8, whole)
    return max(whole, 0.95 * SequenceMatcher(None, leaf, other).ratio())


def _help(command: str) -> str:
    return f"manip-il {command or 'COMMAND'} --help"


def _types(option_type: object) -> tuple[object, ...]:
    """The members of a union, or the type alone."""
    return typing.get_args(option_type) or (option_type,)
