"""Ways of a hand: what they are made of."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.benchmark.feel_hands import SETTLES, reaches, stop, tone, tremor

PERIOD, DT = 4.0, 0.001
TIMES = SETTLES + np.arange(0.0, PERIOD, DT)


def test_a_tremor_is_flat_within_its_band_has_nothing_outside_and_the_rms_that_was_asked_for() -> None:
    way = tremor((8.0, 12.0), 1e-3, PERIOD, seed=3)
    trembled = np.array([way(t) for t in TIMES])
    assert np.sqrt(np.mean(trembled**2)) == pytest.approx(1e-3, rel=1e-6)
    power, frequencies = np.abs(np.fft.rfft(trembled)) ** 2, np.fft.rfftfreq(len(trembled), DT)
    within = (frequencies > 7.9) & (frequencies < 12.1)
    np.testing.assert_allclose(power[within], power[within].mean(), rtol=1e-6)
    assert power[~within].sum() < 1e-12 * power.sum()
    assert [way(t) for t in TIMES[:5]] == [tremor((8.0, 12.0), 1e-3, PERIOD, seed=3)(t) for t in TIMES[:5]]
    assert way(TIMES[5]) != tremor((8.0, 12.0), 1e-3, PERIOD, seed=4)(TIMES[5])


def test_a_steady_motion_lies_under_a_tremor_and_under_a_tone() -> None:
    for moving, still in (
        (tremor((8.0, 12.0), 1e-3, PERIOD, 0, 0.03), tremor((8.0, 12.0), 1e-3, PERIOD, 0)),
        (tone(8.0, 1e-3, 0.03), tone(8.0, 1e-3)),
    ):
        np.testing.assert_allclose([moving(t) - still(t) for t in TIMES[::100]], 0.03 * TIMES[::100], atol=1e-12)
        assert moving(0.0) == still(0.0) == 0.0


def test_a_reach_goes_its_length_in_its_time_rests_and_comes_back() -> None:
    way = reaches(((0.1, 0.6), (0.4, 1.2)), rest=0.3)
    ends = {0.0: 0.0, 0.3: 0.05, 0.6: 0.1, 0.9: 0.1, 1.5: 0.0, 1.8: 0.0, 3.0: 0.4, 3.3: 0.4, 4.5: 0.0, 9.0: 0.0}
    np.testing.assert_allclose([way(t) for t in ends], list(ends.values()), atol=1e-12)
    fastest = np.diff([way(t) for t in np.arange(1.8, 3.0, DT)]).max() / DT
    assert fastest == pytest.approx(1.875 * 0.4 / 1.2, rel=1e-4)


def test_a_hand_that_stops_does_so_within_the_ramp() -> None:
    way = stop(speed=0.3, ramp=0.1, cruises=0.4)
    assert (way(0.3) - way(0.2)) / 0.1 == pytest.approx(0.3)
    assert way(0.5) == pytest.approx(0.12)
    assert way(2.0) == pytest.approx(0.12)
