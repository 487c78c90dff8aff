"""Percentiles that a histogram tells are those of the values that it was given."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.summary.histogram import NOTHING_MEASURED, Histogram, Percentiles


@pytest.mark.parametrize("size", [1, 2, 10, 99, 101, 5000])
@pytest.mark.parametrize("scale", [1e-5, 3e-4, 5e-3])
def test_percentiles_are_numpy_s_to_a_thousandth_of_the_unit(size: int, scale: float) -> None:
    values = np.random.default_rng(size).exponential(scale, size)
    histogram = Histogram(1e-3)
    for value in values:
        histogram.add(value)
    found = histogram.percentiles()
    expected = 1e3 * np.percentile(values, [50, 99], method="inverted_cdf")
    assert [found.p50, found.p99] == pytest.approx(expected, abs=1.001e-3)
    assert found.max == pytest.approx(1e3 * values.max(), rel=1e-12)


def test_what_is_beyond_its_range_counts_as_the_largest() -> None:
    histogram = Histogram(1e-3)
    for value in (0.2, 0.5, 3.0):
        histogram.add(value)
    assert histogram.percentiles().p50 == pytest.approx(3000.0)


@pytest.mark.parametrize("value", [float("nan"), float("inf"), float("-inf")])
def test_what_is_no_duration_does_not_count(value: float) -> None:
    histogram = Histogram(1e-3)
    histogram.add(value)
    assert histogram.percentiles().max is None


@pytest.mark.parametrize("value", [-1.0, -1e300, 1e300])
def test_any_finite_number_can_be_added(value: float) -> None:
    histogram = Histogram(1e-3)
    histogram.add(value)
    histogram.add(1e-3)
    assert histogram.percentiles().p50 is not None


def test_other_units_are_a_factor_and_nothing_stays_nothing() -> None:
    assert Percentiles(0.5, 2.0, 3.0).scaled(1e3) == Percentiles(500.0, 2000.0, 3000.0)
    assert NOTHING_MEASURED.scaled(1e3) == NOTHING_MEASURED
