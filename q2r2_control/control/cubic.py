"""Interpolate positions and velocities between two ticks with the cubic polynomial through both references."""

from __future__ import annotations

from q2r2_control.types import Array


def cubic(x: float, h: float, q: tuple[Array, Array], v: tuple[Array, Array]) -> tuple[Array, Array]:
    """Return position [rad] and velocity [rad/s] on the cubic when the share ``x`` of a time ``h`` [s] has passed.

    The cubic has the given positions and velocities at both ends. If the reference had a constant acceleration between
    both ends, the cubic is the parabola on which it moved.

    Args:
        x: Share of the time that has passed, from 0 to 1.
        h: Time from the start to the end, above 0 [s].
        q: Positions at the start and at the end [rad].
        v: Velocities at the start and at the end [rad/s].
    """
    (start, end), (start_v, end_v) = q, v
    way = end - start
    there = start + x * x * (3.0 - 2.0 * x) * way + x * (1.0 - x) * h * ((1.0 - x) * start_v - x * end_v)
    speed = 6.0 * x * (1.0 - x) / h * way + (1.0 - x) * (1.0 - 3.0 * x) * start_v + x * (3.0 * x - 2.0) * end_v
    return there, speed
