import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.errors import UnknownName, UsageError
from manip_il.seeding import BLOCK, MAX_ROUNDS, MAX_SEED, rng_for, stream_base, stream_seeds

NAMED = ("demonstrations", "training", "validation", "test", "certificate", "held_out")
STREAMS = [*NAMED, *(f"round/{i}" for i in range(MAX_ROUNDS))]
LEROBOT_SEED = 1000
streams, seeds = st.sampled_from(STREAMS), st.integers(0, MAX_SEED)


@given(streams, seeds, streams, seeds)
def test_streams_never_meet(left: str, left_seed: int, right: str, right_seed: int):
    one, other = stream_seeds(left, BLOCK, left_seed), stream_seeds(right, BLOCK, right_seed)
    apart = one[-1] < other[0] or other[-1] < one[0]
    assert apart == ((left, left_seed) != (right, right_seed))


@given(streams, seeds)
def test_no_stream_holds_lerobots_seed(stream: str, seed: int):
    assert LEROBOT_SEED not in stream_seeds(stream, BLOCK, seed)


@pytest.mark.parametrize("seed", [-1, MAX_SEED + 1])
def test_a_seed_out_of_range_is_refused(seed: int):
    with pytest.raises(
        UsageError, match=rf"seed is {seed}; expected a whole number from 0 to {MAX_SEED}"
    ):
        stream_base("test", seed)
    with pytest.raises(UnknownName, match="unknown stream of seeds 'round/100'"):
        stream_base("round/100")


def test_one_purpose_draws_the_same_again_and_another_draws_anew():
    def draw(seed: int, purpose: str) -> np.ndarray:
        return rng_for(seed, purpose).uniform(size=8)

    np.testing.assert_array_equal(draw(3, "reset"), draw(3, "reset"))
    assert not np.isin(draw(3, "reset"), draw(3, "noise")).any()
    assert not np.isin(draw(3, "reset"), draw(4, "reset")).any()
