"""beta_i of Ross, Gordon & Bagnell (2011), section 3.6."""

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.algorithms.config import BetaSchedule


@pytest.mark.parametrize(
    ("text", "betas"),
    [
        ("constant:0", [1, 0, 0, 0]),
        ("constant:0.3", [1, 0.3, 0.3, 0.3]),
        ("linear:2", [1, 0.5, 0, 0]),
        ("exponential:0.5", [1, 0.5, 0.25, 0.125]),
    ],
)
def test_the_values_of_a_schedule(text: str, betas: list[float]):
    schedule = BetaSchedule.parse(text)
    assert [schedule(round_) for round_ in range(4)] == pytest.approx(betas)


@given(
    st.one_of(
        st.builds("{}:{}".format, st.sampled_from(["constant", "exponential"]), st.floats(0, 1)),
        st.builds("linear:{}".format, st.floats(1, 50)),
    )
)
def test_the_expert_drives_all_of_round_0_and_never_more_later(text: str):
    betas = [BetaSchedule.parse(text)(round_) for round_ in range(30)]
    assert betas[0] == 1
    assert all(0 <= later <= earlier <= 1 for earlier, later in pairwise(betas))
