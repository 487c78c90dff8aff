"""If the computer's clock is set while a recording is made, the steps of its time are found."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from q2r2_control.recording.clock_steps import clock_step_text, clock_steps
from q2r2_control.types import Array

PERIOD = 0.004  # [s]


def ticks(count: int = 20) -> tuple[npt.NDArray[np.int64], Array, Array]:
    return np.arange(count, dtype=np.int64), PERIOD * np.arange(count, dtype=np.float64), np.full(count, PERIOD)


@pytest.mark.parametrize("step", [5.0, 0.2, -0.01, -5.0])
def test_a_step_of_the_clock_is_found_with_its_time_and_its_size(step: float) -> None:
    numbers, t, dt = ticks()
    t[8:] += step
    assert np.flatnonzero(clock_steps(numbers, t, dt)).tolist() == [8]
    assert clock_steps(numbers, t, dt)[8] == pytest.approx(step)
    assert ("back" in clock_step_text(step)) == (step < 0.0)


def test_neither_late_nor_lost_ticks_nor_uneven_times_of_receipt_count_as_a_step_of_the_clock() -> None:
    numbers, t, dt = ticks()
    late, at_once = t.copy(), t.copy()
    late[8:] += 2.0  # The late tick records this delay in its ``dt``.
    dt_of_late = dt.copy()
    dt_of_late[8] += 2.0
    at_once[5:9] = t[9]
    lost = np.delete(np.arange(2000), np.arange(20, 1990))
    for found in (
        clock_steps(numbers, late, dt_of_late),
        clock_steps(numbers, at_once, dt),
        clock_steps(lost, PERIOD * lost.astype(np.float64), np.full(len(lost), PERIOD)),
    ):
        assert not found.any()
