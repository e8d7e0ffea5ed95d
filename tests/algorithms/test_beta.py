"""beta_i of Ross, Gordon & Bagnell (2011), section 3.6."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from manip_il.algorithms.config import BetaSchedule
from manip_il.errors import UnknownName, UsageError


@pytest.mark.parametrize(
    ("text", "betas"),
    [
        ("constant:0", [1, 0, 0, 0]),
        ("constant:0.3", [1, 0.3, 0.3, 0.3]),
        ("linear:2", [1, 0.5, 0, 0]),
        ("linear:1", [1, 0, 0, 0]),
        ("exponential:0.5", [1, 0.5, 0.25, 0.125]),
        ("exponential:0", [1, 0, 0, 0]),
        ("exponential:1", [1, 1, 1, 1]),
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


@pytest.mark.parametrize(
    ("text", "says"),
    [
        *((text, f"beta is '{text}'; expected") for text in ("linear:0", "linear:-3", "constant:1.1")),
        *((text, f"beta is '{text}'; expected") for text in ("exponential:-0.1", "constant:nan")),
        ("linear", "beta is 'linear'; expected linear:NUMBER"),
        ("constant:", "beta is 'constant:'; expected constant:NUMBER"),
        ("exponential:half", "beta is 'exponential:half'; expected exponential:NUMBER"),
    ],
)
def test_a_parameter_that_is_missing_or_out_of_range_is_refused_and_shown_how(text: str, says: str):
    with pytest.raises(UsageError, match=says):
        BetaSchedule.parse(text)


def test_an_unknown_schedule_answers_with_the_nearest():
    with pytest.raises(UnknownName, match="did you mean 'linear'"):
        BetaSchedule.parse("linaer:5")
