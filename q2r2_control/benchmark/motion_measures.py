"""How smooth a motion is, from what was commanded alone."""

from __future__ import annotations

import numpy as np

from q2r2_control.types import Array

JOLT = 5.0  # change of a joint's acceleration from one tick to the next [rad/s^2]
_TAIL = 0.5  # [s]


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
