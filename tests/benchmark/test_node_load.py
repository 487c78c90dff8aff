"""Figures of a set of nodes, from numbers that are known."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.benchmark.node_load import LoadReport, NodeLoad, speed_ripple, times_of_a_robot
from q2r2_control.types import Array

TIMES: Array = 0.004 * np.arange(2000.0)  # [s]


def circle(times: Array) -> Array:
    """Two joints at constant speed, as a hand on a circle moves."""
    return np.column_stack([np.sin(3.0 * times), np.cos(3.0 * times)])


def test_a_circle_at_constant_speed_has_no_ripple_however_unevenly_it_is_sampled() -> None:
    assert speed_ripple(TIMES, circle(TIMES)) < 0.01
    uneven = np.sort(TIMES + np.random.default_rng(1).uniform(-0.001, 0.001, len(TIMES)))
    assert speed_ripple(uneven, circle(uneven)) < 0.01


@pytest.mark.parametrize("share", [0.05, 0.2])
def test_ripple_is_what_is_added_to_the_speed(share: float) -> None:
    # A speed of 1 + share sqrt(2) sin(w t) along the circle has a ripple of share.
    w = 2.0 * np.pi * 40.0
    along = TIMES - share * np.sqrt(2.0) * np.cos(w * TIMES) / w
    assert speed_ripple(TIMES, circle(along)) == pytest.approx(share, rel=0.1)


def test_a_robot_takes_commands_once_a_period_and_waits_for_one_that_is_missing() -> None:
    sent = np.array([0.0, 0.0041, 0.0079, 0.016, 0.0201])
    np.testing.assert_allclose(times_of_a_robot(sent), np.median(np.diff(sent)) * np.array([0.0, 1.0, 2.0, 4.0, 5.0]))


def test_all_nodes_together_are_in_the_report() -> None:
    report = LoadReport(5.0, 0.002, (NodeLoad("a", 10.0, 20.0), NodeLoad("b", 1.0, 2.0)), 250.0, 0.02)
    assert report.as_json()["total"] == {"node": "all", "idle": 11.0, "moving": 22.0}
