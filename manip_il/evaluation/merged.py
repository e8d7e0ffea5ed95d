"""Parts of one evaluation, each on seeds of its own, as one."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

from manip_il.errors import ManipError, MismatchError
from manip_il.evaluation.results import EvalResult

_SAME = ("policy_sha256", "robot", "task", "settings", "confidence")


def merge_results(parts: Mapping[str, EvalResult]) -> EvalResult:
    """Return all episodes of the parts (name -> part), in the order of their seeds.

    Raises `MismatchError` where they are not of one policy in one world, and `ManipError` for no part, for a seed that
    two of them ran, or for a part that stopped by what it saw: its number of episodes was not fixed before.
    """
    if not parts:
        raise ManipError("no evaluations to merge; expected at least one")
    (first, one), *others = parts.items()
    for name, other in others:
        for what in _SAME if one.policy_sha256 or other.policy_sha256 else ("policy", *_SAME):
            ours, theirs = getattr(one, what), getattr(other, what)
            if ours != theirs:
                raise MismatchError(what, first, ours, name, theirs)
    for name, part in parts.items():
        if part.until_width is not None:
            raise ManipError(f"{name} stopped by --until_width; only parts with a fixed number of episodes merge")
    owner: dict[int, str] = {}
    for name, part in parts.items():
        for episode in part.episodes:
            if episode.seed in owner:
                raise ManipError(
                    f"seed {episode.seed} is in {owner[episode.seed]} and in {name}; give every part seeds of its own, "
                    "by --eval.first= and --eval.n_episodes="
                )
            owner[episode.seed] = name
    episodes = sorted((episode for part in parts.values() for episode in part.episodes), key=lambda one: one.seed)
    return replace(one, episodes=tuple(episodes))
