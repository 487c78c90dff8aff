"""Compute the command of an arm in each millisecond, within the limits of its motion. No robot and no clock is used.

**Jerk.** Between two ticks the reference has a constant acceleration, and so has the certified stop. Let a be the limit
of the acceleration. Where one motion follows the other, the acceleration jumps by up to 2 a. A robot computes the jerk
from commands that are 1 ms apart, so this jump would be a jerk of 2 a / 1 ms. :class:`PositionStream` therefore sends
the mean of the last n positions on the path. The third difference of these means is the difference of two second
differences of the path, divided by n. So the jerk is at most 2 a / (n 1 ms), whatever the path does and wherever its
ticks are. With a = 10 rad/s^2 and n = 5, it is 4,000 rad/s^3.

**Lost commands.** If a command does not arrive in time, the robot goes on with the last acceleration, and leaves the
path. The difference between the robot and the path then goes to zero by a polynomial of fifth degree. The polynomial
begins with the position, velocity and acceleration that the difference has at that time.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from q2r2_control import Array
from q2r2_franka.limits import JOINTS, PERIOD, TORQUE_RATE

MEANS = 5  # Number of positions of which each command is the mean.
SMOOTHING_DELAY = 0.5 * (MEANS - 1) * PERIOD  # Time by which a mean is behind the path [s].
_RETURN = 0.1  # After lost commands, the arm returns to the path within this time [s].
# This share of the limit of the torque rate is used, because a robot computes the rate from rounded numbers.
_RATE_MARGIN = 0.999


class PositionStream:
    """Computes the positions that are sent to one arm."""

    def __init__(self, q: Array) -> None:
        """Make the stream of an arm that rests at ``q`` (7,) [rad]."""
        self._path = deque([q] * MEANS, maxlen=MEANS)
        self._means = deque([q] * 3, maxlen=3)  # The last three means. _sent has the robot's last three positions.
        self._sent = deque([q] * 3, maxlen=3)
        # The coefficients (6, 7) of the polynomial by which the difference between robot and path goes to zero. Its
        # variable is the time since the polynomial began [s].
        self._difference = np.zeros((6, JOINTS))
        self._since = _RETURN

    def next(self, path: Sequence[Array]) -> Array:
        """Return the position to send now (7,) [rad].

        Args:
            path: Positions on the path since the last call, which are 1 ms apart. If there are several, the robot got
                no command in the periods of all positions before the last one.
        """
        for q in path[:-1]:
            self._advance(q)
            newest, before, oldest = self._sent[-1], self._sent[-2], self._sent[-3]
            # Without a command, the robot goes on with the last acceleration.
            self._sent.append(3.0 * newest - 3.0 * before + oldest)
        if len(path) > 1:
            self._begin_return()
        mean = self._advance(path[-1])
        position = mean + self._along(self._since)
        self._sent.append(position)
        return position

    def _advance(self, q: Array) -> Array:
        self._path.append(q)
        mean: Array = np.mean(self._path, axis=0)
        self._means.append(mean)
        self._since = min(self._since + PERIOD, _RETURN)
        return mean

    def _along(self, t: float) -> Array:
        if t >= _RETURN:
            return np.zeros(JOINTS)
        difference: Array = t ** np.arange(6.0) @ self._difference
        return difference

    def _begin_return(self) -> None:
        """Begin the polynomial by which the difference between the robot's positions and the means goes to zero."""
        d = [sent - mean for sent, mean in zip(self._sent, self._means, strict=True)]
        acceleration = (d[2] - 2.0 * d[1] + d[0]) / PERIOD**2
        velocity = (d[2] - d[1]) / PERIOD + 0.5 * PERIOD * acceleration
        T = _RETURN
        ends = np.array([[T**3, T**4, T**5], [3 * T**2, 4 * T**3, 5 * T**4], [6 * T, 12 * T**2, 20 * T**3]])
        left = -np.array([d[2] + velocity * T + 0.5 * acceleration * T**2, velocity + acceleration * T, acceleration])
        self._difference = np.vstack([d[2], velocity, 0.5 * acceleration, np.linalg.solve(ends, left)])
        self._since = 0.0


class TorqueStream:
    """Computes the torques that are sent to one arm."""

    def __init__(self, limit: Array) -> None:
        """``limit`` is the greatest absolute torque of each joint (7,) [Nm]."""
        self._limit, self._sent = limit, np.zeros(JOINTS)

    def next(self, wanted: Array) -> Array:
        """Return the torques to send now (7,) [Nm]: as near to ``wanted`` as the limits allow.

        The torque may change only by the limit of one period, even after periods without a command, because the robot
        keeps the last torque in such periods.
        """
        change = _RATE_MARGIN * TORQUE_RATE * PERIOD
        wanted = np.clip(wanted, -self._limit, self._limit)
        self._sent = np.clip(wanted, self._sent - change, self._sent + change)
        return self._sent
