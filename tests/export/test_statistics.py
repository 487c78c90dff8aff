"""Statistics are those of the rows, and those of parts give those of the whole."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.export.statistics import NAMES, QUANTILES, joined, statistics_of

pytestmark = pytest.mark.slow


def test_statistics_are_those_of_the_rows() -> None:
    rows = np.random.default_rng(1).permutation(np.arange(1, 201)).reshape(-1, 1) * np.array([[1.0, -2.0]])
    found = statistics_of(rows)
    assert tuple(found) == NAMES
    assert found["min"].tolist() == [1.0, -400.0]
    assert found["max"].tolist() == [200.0, -2.0]
    assert found["mean"] == pytest.approx(rows.mean(axis=0))
    assert found["std"] == pytest.approx(rows.std(axis=0))
    assert found["count"].tolist() == [200]
    assert [found[name][0] for name in QUANTILES] == [2.0, 20.0, 100.0, 180.0, 198.0]


def test_numbers_alone_have_statistics_of_size_one() -> None:
    found = statistics_of(np.array([True, False, False, False]))
    assert (found["min"].tolist(), found["max"].tolist(), found["mean"].tolist()) == ([False], [True], [0.25])


def test_parts_together_have_the_statistics_of_the_whole() -> None:
    random = np.random.default_rng(2)
    parts = [random.normal(shift, 2.0, (count, 3)) for shift, count in ((0.0, 50), (5.0, 200), (-3.0, 1))]
    together, whole = joined([statistics_of(part) for part in parts]), statistics_of(np.concatenate(parts))
    for name in ("min", "max", "mean", "std", "count"):
        assert together[name] == pytest.approx(whole[name]), name
    medians = [np.quantile(part, 0.5, axis=0, method="inverted_cdf") for part in parts]
    assert together["q50"] == pytest.approx((50 * medians[0] + 200 * medians[1] + medians[2]) / 251)
