"""What every closed-loop test asserts at every tick: the controller's contract."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from q2r2_control.control.controller import CartesianController
from q2r2_control.types import Array, Reference

_RELATIVE = 1e-9
# Rounding of a velocity difference, in relation to the velocity.
_ROUNDING = 4.0 * np.finfo(np.float64).eps


class Contract:
    """Checks references one after the other, from a start that may be outside limits or in penetration."""

    def __init__(self, controller: CartesianController, q: Array, v: Array | None = None) -> None:
        settings, robot = controller.settings, controller.robot
        self._acceleration = settings.acceleration_limit
        self._velocity = robot.velocity_limit * settings.velocity_scale
        self._lower = robot.position_lower + settings.position_margin
        self._upper = robot.position_upper - settings.position_margin
        self._distance = settings.min_distance
        self._q, self._v = q.copy(), np.zeros_like(q) if v is None else v.copy()
        self._outside = np.maximum(np.maximum(self._lower - q, q - self._upper), 0.0)
        self._too_fast = np.maximum(np.abs(self._v) - self._velocity, 0.0)
        # A tick's slack: full braking may start one longest step late.
        self._longest_step = settings.max_substep
        ahead = q + self._v * self._longest_step
        self._can_stop = self._stops_inside(q, self._v) & self._stops_inside(ahead, self._v)
        self._least_distance: float | None = None
        self._accelerations: list[tuple[float, Array]] = []
        self.fallbacks = 0
        self.uncertified = 0
        self.ticks = 0

    def check(self, reference: Reference, dt: float) -> None:
        """Points 1 to 5 of the contract for one tick of ``dt`` [s]."""
        q, v, a, report = reference.q, reference.v, reference.a, reference.report
        assert np.isfinite(np.concatenate([q, v, a])).all()
        change = np.abs(v - self._v)
        assert (change <= self._acceleration * dt * (1 + _RELATIVE) + _ROUNDING * np.abs(v)).all(), change.max() / dt
        assert np.abs(a).max() <= self._acceleration * (1 + _RELATIVE)
        # No jump: no joint moved faster than its velocities before and after allow.
        fastest = np.maximum(np.abs(v), np.abs(self._v)) + self._acceleration * dt
        assert (np.abs(q - self._q) <= fastest * dt + _ROUNDING * np.abs(q)).all()
        self._check_velocity(v)
        self._check_position(q, v)
        self._check_distance(report.closest_distance)
        self._q, self._v = q, v
        self._accelerations.append((dt, a))
        self.fallbacks += report.fallback
        self.uncertified += not report.certified
        self.ticks += 1

    def _check_velocity(self, v: Array) -> None:
        """Within the limit, or on the way down to it from a start above it."""
        excess = np.maximum(np.abs(v) - self._velocity * (1 + _RELATIVE), 0.0)
        assert (excess <= self._too_fast).all(), excess.max()
        self._too_fast = excess

    def _check_position(self, q: Array, v: Array) -> None:
        """Inside, once the joint could stop inside; before that braking, then returning inward."""
        outside = np.maximum(np.maximum(self._lower - q, q - self._upper), 0.0)
        outside[outside <= _RELATIVE * np.abs(self._upper)] = 0.0
        assert (outside[self._can_stop] == 0.0).all(), outside.max()
        braking = np.abs(v) < np.abs(self._v)
        assert ((outside <= self._outside) | braking).all(), outside.max()
        self._outside = outside
        self._can_stop |= self._stops_inside(q, v) & self._stops_inside(q + v * self._longest_step, v)

    def _stops_inside(self, q: Array, v: Array) -> npt.NDArray[np.bool_]:
        way = v * np.abs(v) / (2.0 * self._acceleration)
        return (q >= self._lower) & (q <= self._upper) & (q + way >= self._lower) & (q + way <= self._upper)

    def _check_distance(self, distance: float) -> None:
        """At min_distance or more; from a start that is closer, never closer again."""
        if self._least_distance is None or self._least_distance < self._distance:
            if self._least_distance is not None:
                assert distance >= min(self._least_distance - 1e-9, self._distance)
            self._least_distance = distance
        else:
            assert distance >= self._distance, distance

    def tail_acceleration(self, duration: float = 0.5) -> float:
        """Norm over the joints of the RMS acceleration over the last ``duration`` [s], in rad/s^2."""
        total, time = 0.0, 0.0
        for dt, a in reversed(self._accelerations):
            total += float(a @ a) * dt
            time += dt
            if time >= duration:
                break
        return float(np.sqrt(total / time))

    @property
    def fallback_share(self) -> float:
        """Share of ticks that did not execute the solver's solution."""
        return self.fallbacks / max(self.ticks, 1)
