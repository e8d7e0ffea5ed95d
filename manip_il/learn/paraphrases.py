"""Other words for a task, by a small grammar, for policies that read."""

import re
import zlib
from collections.abc import Sequence
from functools import lru_cache

import numpy as np

_BEFORE = ("", "task: ", "your task: ", "please do this: ", "now: ", "what to do: ")
_SYNONYMS = (
    ("pick up", "take", "grab", "grasp"),
    ("put", "place", "set"),
    ("bring", "carry", "move"),
    ("push", "shove"),
    ("press", "push down"),
    ("lift", "raise"),
    ("open", "pull open"),
    ("close", "shut"),
    ("insert", "plug in"),
)
_APART = 4  # one paraphrase in so many is kept for tests


@lru_cache(10_000)
def paraphrases(text: str, held_out: bool = False) -> list[str]:
    """Return other texts for a task.

    Args:
        text: The task's text.
        held_out: Return those that no policy is trained on, instead.

    Returns:
        The texts, the same everywhere; the given one is the first of those to train on.
    """
    plain = text[:1].lower() + text[1:].rstrip(".")
    forms = [plain]
    for synonyms in _SYNONYMS:
        for one in synonyms:
            word = re.compile(rf"\b{one}\b")
            if word.search(plain):
                forms = [word.sub(other, form) for form in forms for other in synonyms]
                break
    made = {before + form for form in forms for before in _BEFORE} - {plain}
    ordered = sorted(made, key=lambda one: (zlib.crc32(one.encode()), one))
    first = -(-len(ordered) // _APART)
    return ordered[:first] if held_out else [text, *ordered[first:]]


def rephrased(texts: Sequence[str], seed: Sequence[int]) -> list[str]:
    """Return texts (B,) in other words: equal ones in the same words, drawn by a seed.

    Args:
        texts: Tasks' texts.
        seed: Decides the words.
    """
    rng = np.random.default_rng(seed)
    drawn = {one: str(rng.choice(paraphrases(one))) for one in dict.fromkeys(texts)}
    return [drawn[one] for one in texts]
