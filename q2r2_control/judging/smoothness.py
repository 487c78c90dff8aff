"""How smooth a tool's motion is, by a measure of the literature, in pieces of equal length.

The measure is made for one movement that begins and ends at rest: it falls with its duration and with every
repetition, and of a whole episode it would say how long that is. So it is taken of pieces of :data:`PIECE` in which
the arm is engaged and its tool moves, and the median of those counts.
"""

from __future__ import annotations

import numpy as np
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

from q2r2_control.judging.episode import FRAME, Flags, stretches
from q2r2_control.types import Array

PIECE = 1.0  # [s]
_HOP = 0.25  # from one piece to the next [s]
_FEWEST = 8  # pieces
_SLOWEST = 0.02  # mean speed of a piece that counts [m/s]
_LONGEST_GAP = 0.05  # between two frames [s]
_SMOOTHING = 0.02  # standard deviation of the Gaussian before jerk is taken, which halves the power at 6.6 Hz [s]


def smoothness(t: Array, position: Array, engaged: Flags) -> float | None:
    """Median of :func:`ldlj`, of smoothed positions, over the pieces of a tool's motion.

    ``position`` (n, 3) [m] is at the times ``t`` (n,) [s]. None: fewer than eight pieces, 2.75 s in
    all, move at 20 mm/s on average; the median of so few says little.
    """
    moving = []
    for begin, end in stretches(engaged & np.isfinite(position).all(axis=1)):
        moving += _pieces(t[begin:end], position[begin:end])
    if len(moving) < _FEWEST:
        return None
    return float(np.median([ldlj(_smoothed(piece), FRAME) for piece in moving]))


def _smoothed(position: Array) -> Array:
    """A piece without what its ends make of the smoothing.

    A tick that comes a millisecond late measures a tool at 0.3 m/s 0.3 mm off, and in real time there are many: three
    derivatives of that would be more than those of the motion.
    """
    cut = round(2.0 * _SMOOTHING / FRAME)
    return np.asarray(gaussian_filter1d(position, _SMOOTHING / FRAME, axis=0))[cut:-cut]


def _pieces(t: Array, position: Array) -> list[Array]:
    """Positions (k, 3) of all pieces that move, at even times :data:`FRAME` apart."""
    count, hop = round(PIECE / FRAME) + 1, round(_HOP / FRAME)
    if len(t) < count // 2 or t[-1] - t[0] < PIECE:
        return []
    t, first = np.unique(t, return_index=True)
    when = np.arange(t[0], t[-1], FRAME)
    even = CubicSpline(t, position[first])(when)
    after = np.clip(np.searchsorted(t, when, side="right"), 1, len(t) - 1)
    gaps = t[after] - t[after - 1]
    speed = np.linalg.norm(np.diff(even, axis=0), axis=1) / FRAME
    return [
        even[begin : begin + count]
        for begin in range(0, len(when) - count + 1, hop)
        if speed[begin : begin + count - 1].mean() > _SLOWEST and gaps[begin : begin + count].max() < _LONGEST_GAP
    ]


def ldlj(position: Array, dt: float) -> float:
    """Log dimensionless jerk along positions (k, 3) [m] that are ``dt`` [s] apart.

    LDLJ = -ln(T^3 / v_peak^2 * integral of |d^3 x / dt^3|^2 dt) over the duration T (Balasubramanian,
    Melendez-Calderon, Roby-Brami, Burdet, On the analysis of movement smoothness, JNER 2015, of the dimensionless jerk
    of Hogan and Sternad, Sensitivity of smoothness measures to movement duration, 2009). About -5.3 for one reach of
    minimum jerk.
    """
    velocity = np.diff(position, axis=0) / dt
    jerk = np.diff(velocity, n=2, axis=0) / dt**2
    peak = max(float(np.linalg.norm(velocity, axis=1).max()), np.finfo(float).tiny)
    duration = dt * (len(position) - 1)
    total = duration**3 / peak**2 * float(np.sum(jerk * jerk)) * dt
    return -float(np.log(max(total, np.finfo(float).tiny)))
