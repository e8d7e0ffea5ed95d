"""Texts as inputs of the `mlp` and `cnn` policies: what a task's words change in their networks.

A text is the set of its words and of their letter trigrams, each hashed to a row of an embedding,
as in fastText (Bojanowski et al. 2017, "Enriching word vectors with subword information"). Hence
there is no vocabulary to store, and a word that was never seen is no error: it shares trigrams with
others. The sum of these rows scales and shifts every hidden layer (FiLM: Perez et al. 2018).
"""

from __future__ import annotations

import re
import zlib
from collections.abc import Sequence
from functools import lru_cache

import torch
from torch import Tensor, nn
from torch.nn.functional import one_hot

BUCKETS = 4096  # rows of the embedding; the first one is padding
LENGTH = 160  # most words and trigrams of a text; the rest is not read
_SIZE = 64  # numbers in an embedded text
_WORD = re.compile(r"\w+")


@lru_cache(100_000)
def _tokens(text: str) -> Tensor:
    """Return the rows of a text, (`LENGTH`,), as whole numbers in single precision."""
    words = dict.fromkeys(_WORD.findall(text.lower()))
    pieces = [f"<{word}>" for word in words]
    pieces += [piece[i : i + 3] for piece in pieces for i in range(len(piece) - 2)]
    rows = [1 + zlib.crc32(piece.encode()) % (BUCKETS - 1) for piece in dict.fromkeys(pieces)]
    return torch.tensor((rows + [0] * LENGTH)[:LENGTH], dtype=torch.float32)


def tokens(texts: Sequence[str]) -> Tensor:
    """Return texts as inputs of a network, (B, l), the same on every machine; l is `LENGTH`."""
    return torch.stack([_tokens(text) for text in texts])


class TextReader(nn.Module):
    """How a text changes the hidden layers of a network.

    Args:
        sizes: Number of units or channels in each layer.
    """

    def __init__(self, sizes: Sequence[int]) -> None:
        super().__init__()
        self.sizes = [2 * size for size in sizes]
        self.rows = nn.EmbeddingBag(BUCKETS, _SIZE, mode="sum", padding_idx=0)
        nn.init.normal_(self.rows.weight, std=_SIZE**-0.5)
        self.changes = nn.Linear(_SIZE, sum(self.sizes))
        nn.init.zeros_(self.changes.weight)  # it begins as a network that reads nothing
        nn.init.zeros_(self.changes.bias)

    def forward(self, texts: Tensor) -> list[tuple[Tensor, Tensor]]:
        """Return the factor and the shift of each layer's units, (B, size) each, for texts from
        `tokens`, (B, `LENGTH`).
        """
        if self.training:  # few texts, each read once; the last bits depend on the others
            texts, places = texts.unique(dim=0, return_inverse=True)
            changes = self.changes(self.rows(texts.long()))
            # as `changes[places]`, whose gradient takes ten times as long
            changes = one_hot(places, len(texts)).to(changes) @ changes
        else:
            changes = self.changes(self.rows(texts.long()))
        halves = (one.chunk(2, dim=1) for one in changes.split(self.sizes, dim=1))
        return [(1 + factor, shift) for factor, shift in halves]
