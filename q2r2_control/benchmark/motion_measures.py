"""How smooth a motion is, from what was commanded alone."""

from __future__ import annotations

import numpy as np

from q2r2_control.types import Array

JOLT = 5.0  # change of a joint's acceleration from one tick to the next [rad/s^2]
_TAIL = 0.5  # [s]
_TREND = 0.15  # a slower motion is the hand's own, a faster one is ripple [s]


def rest_acceleration(v: Array, dt: float) -> float:
    """RMS over the last 0.5 s of velocities (n, nv) [rad/s], of the acceleration's norm over the joints [rad/s^2]."""
    a = np.diff(v, axis=0, prepend=0.0)[-round(_TAIL / dt) :] / dt
    return float(np.sqrt(np.mean(np.sum(a**2, axis=1))))


def count_jolts(v: Array, dt: float, since: float) -> int:
    """Ticks of velocities (n, nv) [rad/s] after which a joint's acceleration changes by more than :data:`JOLT`.

    Counts from ``since`` [s] on.
    """
    a = np.diff(v, axis=0, prepend=0.0) / dt
    changes = np.abs(np.diff(a, axis=0)).max(axis=1)
    return int((changes[round(since / dt) :] > JOLT).sum())


def speed_ripple(times: Array, q: Array) -> float:
    """RMS of the speeds between joint positions about their trend, as a share of the trend's RMS.

    ``times`` (n,) [s], ascending; ``q`` (n, nv) [rad]. The trend is a mean over 0.15 s, weighted by a Hann window.
    """
    dt = np.diff(times)
    v = np.diff(q, axis=0) / dt[:, None]
    window = np.hanning(2 * max(round(_TREND / float(np.median(dt)) / 2.0), 1) + 1)
    trend = np.apply_along_axis(lambda column: np.convolve(column, window / window.sum(), "valid"), 0, v)
    margin = len(window) // 2
    ripple = v[margin : len(v) - margin] - trend
    return float(np.sqrt((ripple**2).sum() / (trend**2).sum()))
