"""The joint servos of the simulated robot: gains that stay stable at a physics step, and the reference they follow."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from q2r2_control.types import Array

# A joint's inertia is never less than its armature, whatever the posture: M >= diag(armature). With K dt^2 / armature
# <= 0.16 and D dt / armature <= 1 all eigenvalues of 2 D dt + K dt^2 over M stay below 4, where semi-implicit Euler
# integration turns unstable.
_MAX_STIFFNESS_STEP, _MAX_DAMPING_STEP = 0.16, 1.0


@dataclass(frozen=True, slots=True)
class ServoGains:
    """Gains of one proportional-derivative servo a joint."""

    stiffness: Array  # (nv,) [Nm/rad]
    damping: Array  # (nv,) [Nm s/rad]


def servo_gains(stiffness: float, damping_ratio: float, inertia: Array, armature: Array, timestep: float) -> ServoGains:
    """Gains for ``stiffness`` [Nm/rad] with ``damping_ratio`` at the effective ``inertia`` (nv,) [kg m^2].

    Both are held below what a ``timestep`` [s] can integrate with joints of this ``armature`` (nv,) [kg m^2].
    """
    wanted = np.minimum(stiffness, _MAX_STIFFNESS_STEP * armature / timestep**2)
    damping = 2 * damping_ratio * np.sqrt(wanted * inertia)
    return ServoGains(wanted, np.minimum(damping, _MAX_DAMPING_STEP * armature / timestep))


class ReferenceLine:
    """Where the servos have to be during a tick: on a straight line from the last command to the newest.

    At a tick without a newer command they rest where the last one led, so that a velocity never outlives its tick.
    """

    def __init__(self, q: Array) -> None:
        self._start_q = self._end_q = q.copy()
        self._start_v = self._end_v = np.zeros_like(self._end_q)
        self._next: tuple[Array, Array] | None = None

    @property
    def end_q(self) -> Array:
        """Where the last tick's line ended (nv,) [rad]."""
        return self._end_q

    def command(self, q: Array, v: Array) -> None:
        """Set posture and velocity (nv,) due at the end of the next tick."""
        self._next = (q.copy(), v.copy())

    def begin_tick(self) -> None:
        """Turn to the newest command, or to rest."""
        self._start_q = self._end_q
        if self._next is None:
            self._start_v = self._end_v = np.zeros(len(self._end_v))
        else:
            self._start_v = self._end_v
            self._end_q, self._end_v = self._next
            self._next = None

    def at(self, fraction: float) -> tuple[Array, Array]:
        """Posture and velocity after ``fraction`` 0..1 of the tick."""
        if fraction == 0:
            return self._start_q, self._start_v
        return (
            self._start_q + fraction * (self._end_q - self._start_q),
            self._start_v + fraction * (self._end_v - self._start_v),
        )

    def acceleration(self, duration: float) -> Array:
        """Acceleration (nv,) during a tick of ``duration`` [s]."""
        return (self._end_v - self._start_v) / duration
