"""Where the times of a recording's ticks do not go on as its loop did: one rule, for the judge and the export.

ROS time is the computer's clock, or a simulation's. Somebody or a time server may set it forward or back while arms
move. A recording then has seconds twice, or seconds of which there is nothing.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from q2r2_control.types import Array

_NOTED = 0.1  # by which time goes on farther than the loop, before it says anything [s]: receipts come unevenly
_SHARE = 0.5  # of the time of ticks that were lost, whose own dt nobody knows


def clock_steps(numbers: npt.NDArray[np.int64], t: Array, dt: Array) -> Array:
    """By how much the clock was set before each of n ticks (n,) [s]: forward, or back where negative; 0 as a rule.

    A controller that stood still, and counts less time than passed, looks the same as a clock that was set forward.

    Args:
        numbers: Of the ticks (n,).
        t: Times of the ticks (n,) [s].
        dt: Time since the tick before, as its loop counted (n,) [s].
    """
    passed, ticks = np.diff(t, prepend=t[:1]), np.diff(numbers, prepend=numbers[:1])
    steps = passed - ticks * dt
    noted = (passed < 0.0) | (np.abs(steps) > _NOTED + _SHARE * (ticks - 1).clip(0) * dt)
    return np.where(noted, steps, 0.0)


def clock_step_text(step: float) -> str:
    """Words on a ``step`` [s] of :func:`clock_steps`."""
    if step < 0.0:
        return f"a clock was set back by {-step:.3f} s"
    return f"a clock was set forward, or the controller stood still, by {step:.3f} s"
