"""An error that a clone does not correct goes the way of the open loop.

Noise on the demonstrations mends it.
"""

from manip_il.chapter.theory.linear import GUST, drifts


def test_clones_drift_with_the_open_loop_and_noise_mends_it():
    for drift in drifts():
        pole, end = drift.pole, drift.apart[-1]
        assert drift.error < 2 * GUST  # all of them do well in the expert's states
        if drift.noise:
            assert end < 1e-9
        elif pole < 1:
            assert end < 5 * GUST / (1 - pole)
        elif pole == 1:
            assert GUST < end < 40 * GUST
            assert 1 < drift.growth < 1.05
        else:
            assert abs(drift.growth - pole) < 0.01
            assert end > 1_000 * GUST
