import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from manip_il.errors import ManipError, NotFiniteError
from manip_il.mdp import STATE_EXTRAS, Episode, Label, Observation, State

finite = st.floats(allow_nan=False, allow_infinity=False)


@given(
    arrays(np.float64, st.integers(0, 40), elements=finite),
    arrays(np.float64, st.integers(0, 15), elements=finite),
    st.integers(0, 10_000),
    st.integers(0, 10_000),
    st.booleans(),
)
def test_a_state_survives_its_vector_bit_for_bit(
    physics, variation, step: int, streak: int, ever: bool
):
    state = State(physics, variation, step, streak, ever)
    vector = state.to_vector()
    assert (vector.dtype, len(vector)) == (np.float64, len(physics) + len(variation) + STATE_EXTRAS)
    again = State.from_vector(vector)
    assert again.physics.tobytes() == physics.tobytes()
    assert again.variation.tobytes() == variation.tobytes()
    assert (again.step, again.streak, again.ever) == (step, streak, ever)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
@pytest.mark.parametrize(
    ("make", "words"),
    [
        (
            lambda bad: State(np.array([0.0, 0.0, bad]), np.zeros(3)),
            r"State\.physics: .* at index 2",
        ),
        (
            lambda bad: State(np.zeros(4), np.array([0.0, bad, 0.0])),
            r"State\.variation: .* at index 1",
        ),
        (lambda bad: Label(np.array([bad]), 1, True, 0.0), r"Label\.action"),
        (
            lambda bad: Observation(np.zeros(2, "f4"), np.array([bad], "f4")),
            r"observation\.environment_state",
        ),
        (
            lambda bad: Episode(12, {"action": np.array([[0, 0], [0, bad], [0, 0]])}, False, False),
            r"episode 12, action: .* at frame 1 is not finite",
        ),
    ],
)
def test_what_is_not_finite_is_refused_where_it_enters(make, words: str, bad: float):
    with pytest.raises(NotFiniteError, match=words):
        make(bad)


def test_an_episode_has_frames_and_columns_of_one_length():
    assert len(Episode(0, {"action": np.zeros((3, 2)), "actor": np.zeros((3, 1))}, True, True)) == 3
    with pytest.raises(ManipError, match=r"'action': 3.*'actor': 4"):
        Episode(0, {"action": np.zeros((3, 2)), "actor": np.zeros((4, 1))}, False, False)
    with pytest.raises(ManipError, match="no frames"):
        Episode(5, {"action": np.zeros((0, 2))}, False, False)
