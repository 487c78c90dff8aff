"""A plant without sessions may report a fault. The arms then rest, and the run goes on."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control.events import CommonReason, Reason
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from tests.recording.runs import pipeline
from tests.support.processes import cell

WHY = Reason.in_words("a drive is hot")


class HotPlant(KinematicPlant):
    """Reports a fault from the time ``hot_from`` on [s]."""

    hot_from = 0.0

    def fault(self) -> Reason | None:
        return WHY if self.state().stamp >= self.hot_from else None


def run(hot_from: float) -> tuple[RunSummary, list[Tick]]:
    """Run circles, during which the arms engage at 0.7 s and move from 1.2 s on."""
    config = cell()
    plant = HotPlant(Robot.from_config(config), config)
    plant.hot_from = hot_from
    loop: Pipeline = pipeline(plant=plant)
    ticks: list[Tick] = []
    loop.listeners.append(ticks.append)
    return loop.run(2.2, realtime=False), ticks


@pytest.mark.slow
def test_arms_brake_at_a_fault_and_the_run_ends_without_an_exception_although_the_fault_lasts() -> None:
    summary, ticks = run(hot_from=1.8)
    before = next(tick for tick in ticks if tick.state.stamp >= 1.8)
    assert np.abs(before.reference.v).max() > 0.02  # The arms moved when the fault came.
    assert ticks[-1].t > 2.15
    assert np.abs(ticks[-1].reference.v).max() < 1e-6
    np.testing.assert_allclose(ticks[-1].state.q, ticks[-1].reference.q, atol=1e-9)  # The plant followed the stop.
    lost = {event.arm: event.reason for event in summary.events if event.destination == "lost"}
    assert lost == {"left": WHY, "right": WHY}


@pytest.mark.slow
def test_arms_do_not_move_if_a_run_begins_during_a_fault_and_a_press_is_refused_for_it(
    caplog: pytest.LogCaptureFixture,
) -> None:
    summary, ticks = run(hot_from=0.0)
    assert len(ticks) > 1000
    assert all((tick.state.q == ticks[0].state.q).all() for tick in ticks)
    assert {event.reason.root.kind for event in summary.events} == {CommonReason.OTHER}
    assert [line for line in caplog.messages if line.startswith("the plant")] == [
        "the plant reports a fault: a drive is hot"
    ]
