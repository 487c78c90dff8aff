"""Joint commands that come at their own pace, made a motion at the plant's pace, and a stop without them."""

from __future__ import annotations

import numpy as np

from q2r2_control.types import Array

# How long a joint goes on at the commanded velocity when the next command is late: three times what lies between two,
# since a busy machine delivers them unevenly, but within these bounds [s].
_COAST_INTERVALS, _SHORTEST_COAST, _LONGEST_COAST = 3.0, 0.01, 0.1
# Share of the newest interval in its running mean.
_INTERVAL_SHARE = 0.1


class JointFollower:
    """Where each joint has to be at any time, from the newest command that names it.

    A command says posture and velocity at a time; in between the joint moves on at that velocity. When the next command
    stays out the joint brakes at its ``acceleration_limit`` (nv,) [rad/s^2], so that a velocity never outlives its
    sender. No joint moves faster than its ``velocity_limit`` (nv,) [rad/s]. Times are seconds on one clock that is
    passed in.
    """

    def __init__(self, q: Array, acceleration_limit: Array, velocity_limit: Array) -> None:
        self._acceleration, self._velocity_limit = acceleration_limit, velocity_limit
        self.stop(q, np.zeros_like(q))

    def stop(self, q: Array, v: Array) -> None:
        """Forget all commands and brake from posture ``q`` and velocity ``v`` (nv,)."""
        self.q, self.v = q.copy(), np.minimum(np.maximum(v, -self._velocity_limit), self._velocity_limit)
        self._command_q, self._command_v = q.copy(), np.zeros_like(q)
        self._due = np.full(len(q), -np.inf)
        self._interval = np.full(len(q), _SHORTEST_COAST)

    def command(self, joints: Array, q: Array, v: Array | None, due: float) -> None:
        """Posture ``q`` and velocity ``v`` of the joints with these indices at time ``due`` [s].

        Without ``v`` the velocity is what leads from the last command to this one in the time between two.
        """
        interval = due - self._due[joints]
        known = (interval > 0.0) & (interval <= _LONGEST_COAST)
        mean = self._interval[joints]
        # The first interval after a silence says nothing, and one alone nothing certain.
        mean = np.where(known, mean + _INTERVAL_SHARE * (interval - mean), mean)
        if v is None:
            v = np.where(known, (q - self._command_q[joints]) / mean, 0.0)
        limit = self._velocity_limit[joints]
        self._interval[joints] = mean
        self._command_q[joints] = q
        self._command_v[joints] = np.minimum(np.maximum(v, -limit), limit)
        self._due[joints] = due

    def advance(self, now: float, dt: float) -> None:
        """Move ``q`` and ``v`` on by ``dt`` [s], to the time ``now`` [s]."""
        age = now - self._due
        coast = np.minimum(np.maximum(_COAST_INTERVALS * self._interval, _SHORTEST_COAST), _LONGEST_COAST)
        fresh = age <= coast
        reach = self._velocity_limit * dt
        if fresh.all():
            way = self._command_q + self._command_v * age - self.q
            if (np.abs(way) <= reach).all():  # as it is but for a joint that is left behind
                self.q, self.v = self.q + way, self._command_v.copy()
                return
        slower = np.sign(self.v) * np.maximum(np.abs(self.v) - self._acceleration * dt, 0.0)
        way = np.where(
            fresh, self._command_q + self._command_v * np.where(fresh, age, 0.0) - self.q, 0.5 * (self.v + slower) * dt
        )
        bounded = np.minimum(np.maximum(way, -reach), reach)
        self.q = self.q + bounded
        # A joint that is far from where it should be catches up at its limit; its velocity is then that of this way.
        on_time = np.abs(way) <= reach
        self.v = np.where(fresh, np.where(on_time, self._command_v, bounded / dt), slower)
