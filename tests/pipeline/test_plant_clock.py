"""A plant's states are stamped by the loop's clock, and one that hangs gives states that grow old."""

from __future__ import annotations

import numpy as np

from q2r2_control.pipeline.loop_clock import PlantClock
from q2r2_control.types import RobotState


def state(stamp: float) -> RobotState:
    return RobotState(np.zeros(2), np.zeros(2), np.zeros(2), None, stamp)


def test_states_of_a_plant_whose_clock_began_elsewhere_are_as_new_as_they_come() -> None:
    clock = PlantClock(state(1000.0))
    for tick in range(1, 4):
        clock.give(0.01)
        seen, passed = clock.stamped(state(1000.0 + 0.01 * tick), 5.0 + 0.01 * tick)
        assert (seen.stamp, passed) == (5.0 + 0.01 * tick, 1000.0 + 0.01 * tick - (1000.0 + 0.01 * (tick - 1)))


def test_a_state_that_is_repeated_is_as_old_as_the_time_that_the_plant_was_given() -> None:
    clock, stopped = PlantClock(state(0.0)), state(0.0)
    for tick in range(1, 4):
        clock.give(0.25)
        seen, passed = clock.stamped(stopped, 5.0 + 0.25 * tick)
        assert (seen.stamp, passed) == (5.0, 0.0)
    seen, passed = clock.stamped(state(0.75), 6.0)
    assert (seen.stamp, passed) == (6.0, 0.75)


def test_a_clock_that_goes_back_is_told_as_it_is() -> None:
    clock = PlantClock(state(2.0))
    clock.give(0.01)
    assert clock.stamped(state(1.5), 7.0)[1] == -0.5
