"""An error that a clone does not correct goes the way of the open loop; a partly corrected one may
grow although open loop and expert are stable. Chunks and noise mend what the theorems say.
"""

import numpy as np
import pytest

from manip_il.chapter.theory.linear import BACK, GUST, SYSTEMS, Drift, Remedy, drifts

STABLE, MARGINAL, UNSTABLE, COUPLED = (system.name for system in SYSTEMS)


@pytest.fixture(scope="module")
def measured() -> dict[tuple[str, Remedy], Drift]:
    """Drifts by system and remedy."""
    return {(drift.system, drift.remedy): drift for drift in drifts()}


def test_every_clone_does_well_in_the_experts_states(measured):
    assert all(drift.error < 2 * GUST for drift in measured.values())


def test_what_is_not_corrected_develops_as_the_open_loop(measured):
    for remedy in ("none", "chunks"):
        assert measured[STABLE, remedy].apart[-1] < 2 * GUST
        assert GUST < measured[MARGINAL, remedy].apart[-1] < 40 * GUST
        assert measured[UNSTABLE, remedy].growth == pytest.approx(1.25, abs=0.01)


def test_a_clone_can_be_unstable_where_open_loop_and_expert_are_stable(measured):
    coupled, states = SYSTEMS[-1], np.eye(2)
    assert coupled.radius < 1
    assert coupled.move(states, coupled.expert(states)) == pytest.approx(BACK * states)
    assert measured[COUPLED, "none"].growth == pytest.approx(1.2, abs=0.01)
    assert measured[COUPLED, "none"].apart[-1] > 1_000 * GUST


def test_chunks_mend_it_where_the_open_loop_is_stable(measured):
    assert max(measured[COUPLED, "chunks"].apart) < 20 * GUST


def test_noise_on_the_demonstrations_mends_all(measured):
    assert all(measured[system.name, "noise"].apart[-1] < 1e-9 for system in SYSTEMS)
