"""What a filter feels like: the figures are those of the hand and the tool, whatever the settings say of themselves."""

from __future__ import annotations

import pytest

from q2r2_control.benchmark import feel_run
from q2r2_control.benchmark.feel_run import SPEED, FeelFigures, run_feel
from tests.support.watch import cell

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def measured() -> tuple[FeelFigures, FeelFigures]:
    """The cell's filter and a fast one, with fewer tones and reaches than in the benchmark."""
    told: list[str] = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(feel_run, "MOTIONS", ((1.0, 0.04),))
        patch.setattr(feel_run, "TREMORS", (10.0,))
        patch.setattr(feel_run, "REACHES", ((0.1, 0.6), (0.3, 1.0)))
        patch.setattr(feel_run, "_BAND_PERIOD", 2.0)
        usual, fast = run_feel(cell(), told.append, {"speed": SPEED})
    assert told == ["this cell", "speed"]
    return usual, fast


def test_the_tool_is_later_than_the_filter_alone_and_by_little(measured: tuple[FeelFigures, FeelFigures]) -> None:
    for figures in measured:
        assert 0.0 < figures.delays_ms[0] - figures.filter_delay_ms < 40.0
        assert -1.0 < figures.gains_db[0] < 2.0


def test_a_filter_for_speed_is_less_late_and_lets_more_tremor_through(
    measured: tuple[FeelFigures, FeelFigures],
) -> None:
    usual, fast = measured
    assert fast.delays_ms[0] < usual.delays_ms[0] - 15.0
    assert fast.stop_delay_ms < usual.stop_delay_ms
    assert usual.tremors_db[0] < -12.0
    assert fast.tremors_db[0] > usual.tremors_db[0] + 3.0


def test_a_reach_is_late_by_no_more_than_60_ms_and_of_a_tremor_within_its_band_a_quarter_is_left(
    measured: tuple[FeelFigures, FeelFigures],
) -> None:
    usual, fast = measured
    assert usual.filter_delay_ms < usual.reach_delay_ms <= 60.0
    assert usual.reach_delay_ms < usual.worst_reach_delay_ms < 70.0
    assert fast.reach_delay_ms < usual.reach_delay_ms - 15.0
    for usually, fastly in ((usual.band_db, fast.band_db), (usual.band_at_rest_db, fast.band_at_rest_db)):
        assert -16.0 < usually < -12.0
        assert fastly > usually + 3.0


def test_a_hand_that_rests_is_hardly_heard(measured: tuple[FeelFigures, FeelFigures]) -> None:
    for figures in measured:
        assert figures.tremor_at_rest_db < -12.0
        assert figures.noise_um < 50.0
