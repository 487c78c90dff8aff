"""Percentiles that a histogram tells are those of the values that it was given."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.summary.run_summary import NOTHING_MEASURED, Histogram


@pytest.mark.parametrize("size", [1, 2, 99, 5000])
def test_percentiles_are_numpy_s_to_a_thousandth_of_the_unit(size: int) -> None:
    values = np.random.default_rng(size).exponential(3e-4, size)
    histogram = Histogram(1e-3)
    for value in values:
        histogram.add(value)
    found = histogram.percentiles(1e-6)
    expected = 1e6 * np.percentile(values, [50, 99], method="inverted_cdf")
    assert [found.p50, found.p99] == pytest.approx(expected, abs=1.001)
    assert found.max == pytest.approx(1e6 * values.max(), rel=1e-12)


def test_any_number_can_be_added_and_one_beyond_the_range_counts_as_the_largest() -> None:
    histogram = Histogram(1e-3)
    for value in (float("nan"), float("inf"), float("-inf")):
        histogram.add(value)
    assert histogram.percentiles(1e-3) == NOTHING_MEASURED
    for value in (-1e300, 0.2, 0.5, 3.0, 1e300):
        histogram.add(value)
    assert histogram.percentiles(1e-3).p50 == pytest.approx(1e303)
