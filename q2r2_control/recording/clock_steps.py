"""Finds ticks of a recording between which a clock was set. The judge and the export use the same rule.

ROS time is the clock of the computer or of a simulation. A person or a time server may set it forward or back while
arms move. A recording then has some seconds twice, or a gap of some seconds.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from q2r2_control.types import Array

# A smaller difference between the clock and the loop's own time is not a step, because messages arrive unevenly [s].
_NOTED = 0.1
# After lost ticks, the threshold is ``_NOTED`` plus this share of their estimated duration, because the dt of a lost
# tick is not known.
_SHARE = 0.5


def clock_steps(numbers: npt.NDArray[np.int64], t: Array, dt: Array) -> Array:
    """Return, for each of n ticks, by how much the clock was set just before the tick (n,) [s].

    The number is positive if the clock was set forward, negative if it was set back, and 0 if it was not set. The
    number is also positive if the controller stood still and counted less time than passed. The data does not show
    whether the clock was set or the controller stood still.

    Args:
        numbers: Numbers of the ticks (n,).
        t: Times of the ticks by the clock (n,) [s].
        dt: Time since the tick before, as the loop counted it (n,) [s].
    """
    passed, ticks = np.diff(t, prepend=t[:1]), np.diff(numbers, prepend=numbers[:1])
    steps = passed - ticks * dt
    noted = (passed < 0.0) | (np.abs(steps) > _NOTED + _SHARE * (ticks - 1).clip(0) * dt)
    return np.where(noted, steps, 0.0)


def clock_step_text(step: float) -> str:
    """Return words that describe a ``step`` [s] of :func:`clock_steps`."""
    if step < 0.0:
        return f"a clock was set back by {-step:.3f} s"
    return f"a clock was set forward, or the controller stood still, by {step:.3f} s"
