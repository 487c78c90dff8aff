"""What the torques of a run amount to, and that a tick without a measurement spoils no figure."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.summary.run_summary import TorqueSummary

QUIET = ImpedanceReport({}, (), (), (), (), False)
FREE = WallReport(np.zeros(14), (), 0.0, 0.0, ("left_a", "right_b"), 0.2)
HANDS, ELBOWS = ("left_hand", "right_hand"), ("left_elbow", "right_elbow")


@pytest.fixture
def summary() -> TorqueSummary:
    return TorqueSummary({"left": 0.0, "right": 0.0})


def test_extremes_are_kept_and_ticks_are_counted_once_however_many_joints(summary: TorqueSummary) -> None:
    pressed = replace(FREE, pressing=(HANDS, ELBOWS), force=30.0, closest_pair=HANDS, closest_distance=0.015)
    summary.add(0.002, replace(QUIET, saturated=("left_A1", "left_A2"), clipped=("right",)), pressed)
    summary.add(0.002, replace(QUIET, rate_limited=("left_A1",), clipped=("right",)), replace(pressed, force=20.0))
    summary.add(0.002, QUIET, FREE)
    assert summary.min_measured_distance_mm == pytest.approx(15.0)
    assert summary.measured_closest_pair == HANDS
    assert summary.pressed_pairs == [ELBOWS, HANDS]
    assert summary.max_wall_force_n == 30.0
    assert (summary.saturated_ticks, summary.rate_limited_ticks, summary.held_ticks) == (1, 1, 0)
    assert summary.off_reference_s == {"left": 0.0, "right": pytest.approx(0.004)}


@pytest.mark.parametrize("blind_first", [True, False])
def test_a_distance_that_was_not_measured_is_no_distance(summary: TorqueSummary, blind_first: bool) -> None:
    blind = (replace(QUIET, held=True), replace(FREE, closest_pair=("", ""), closest_distance=math.nan))
    for impedance, wall in (blind, (QUIET, FREE)) if blind_first else ((QUIET, FREE), blind):
        summary.add(0.001, impedance, wall)
    assert (summary.min_measured_distance_mm, summary.held_ticks) == (pytest.approx(200.0), 1)


def test_a_cell_without_pairs_has_no_distance(summary: TorqueSummary) -> None:
    summary.add(0.001, QUIET, replace(FREE, closest_pair=("", ""), closest_distance=math.inf))
    assert summary.min_measured_distance_mm is None
    assert summary.measured_closest_pair is None
