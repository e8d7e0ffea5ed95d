"""Named random streams with disjoint seeds.

An episode's seed is `stream_base(stream) + index`. Each stream has a block of `BLOCK` seeds, and
each value of the user's `--seed` shifts all streams to other blocks, so that demonstrations, every
DAgger round, training, validation and the final test never share a seed, and no stream holds 1000,
LeRobot's default seed.
"""

import zlib

import numpy as np

from manip_il.errors import UnknownName, UsageError

BLOCK = 1_000_000  # seeds in one stream
MAX_ROUNDS = 100
_STREAMS = {
    "demonstrations": 1,
    "training": 2,
    "validation": 3,
    "test": 4,
    "certificate": 5,
    "held_out": 6,
    "redraw": 7,
    "theory": 8,
    "reinforcement": 9,
}
_FIRST_ROUND = 10  # rounds take blocks 10, 11, ...
_BLOCKS_PER_SEED = _FIRST_ROUND + MAX_ROUNDS
MAX_SEED = 1_000


def stream_base(stream: str, seed: int = 0) -> int:
    """Return the first seed of a named stream.

    Args:
        stream: `demonstrations`, `training`, `validation`, `test`, `round/3`, ...
        seed: The user's `--seed`, 0 to `MAX_SEED`.

    Raises:
        UsageError: The seed is out of range.
        UnknownName: There is no such stream.
    """
    if not 0 <= seed <= MAX_SEED:
        raise UsageError(f"seed is {seed}; expected a whole number from 0 to {MAX_SEED}")
    return (seed * _BLOCKS_PER_SEED + _block(stream)) * BLOCK


def stream_seeds(stream: str, count: int, seed: int = 0) -> range:
    """Return the first seeds of a named stream.

    Args:
        stream: The name, as for `stream_base`.
        count: The number of seeds, 0 to `BLOCK`.
        seed: The user's `--seed`, 0 to `MAX_SEED`.

    Raises:
        UsageError: The count or the seed is out of range.
    """
    if not 0 <= count <= BLOCK:
        raise UsageError(f"{count} seeds requested from stream {stream!r}; expected 0 to {BLOCK}")
    base = stream_base(stream, seed)
    return range(base, base + count)


def rng_for(seed: int, purpose: str, *step: int) -> np.random.Generator:
    """Return a generator for one purpose (`reset`, `mixture`, `noise`, ...) in the episode of a
    seed, or in one step.

    What happens in a step of an environment is drawn from a generator of that step, and so does not
    depend on the steps that the environment has made before: a restored state has the same future.
    """
    return np.random.default_rng([seed, zlib.crc32(purpose.encode()), *step])


def _block(stream: str) -> int:
    kind, _, number = stream.partition("/")
    if kind == "round" and number.isdecimal() and int(number) < MAX_ROUNDS:
        return _FIRST_ROUND + int(number)
    if stream not in _STREAMS:
        raise UnknownName("stream of seeds", stream, [*_STREAMS, "round/0 to 99"])
    return _STREAMS[stream]
