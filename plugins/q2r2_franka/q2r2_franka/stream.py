"""Compute the command of an arm in each millisecond, within the limits of its motion. No robot and no clock is used.

**Jerk.** Between two ticks the reference has a constant acceleration, and so has the certified stop. Let a be the limit
of the acceleration. Where one motion follows the other, the acceleration jumps by up to 2 a. A robot computes the jerk
from commands that are 1 ms apart, so this jump would be a jerk of 2 a / 1 ms. :class:`PositionStream` therefore sends
the mean of the last n positions on the path. The third difference of these means is the difference of two second
differences of the path, divided by n. So the jerk j is at most 2 a / (n 1 ms), whatever the path does and wherever its
ticks are. With a = 4.8 rad/s^2 and n = 8, it is 1,200 rad/s^3.

**Lost commands.** If a command does not arrive in time, the robot drops it, goes on with the last acceleration, and
leaves the path. The sender of a late command does not see this from the number of states that it has read. But each
state reports the last position that the robot commanded itself (q_d, "after the extrapolation due to packet losses",
overview of libfranka's documentation). From this position, the stream finds out whether the robot took the last
command. The difference between the robot and the path then goes to zero by a polynomial of fifth degree. The polynomial
begins with the position, velocity and acceleration that the difference has at that time.

**Errors.** The stream can be wrong about whether the robot took the last command. Such an error has a small effect. A
single lost command leaves the robot at most j (1 ms)^3 from the mean. The next difference then has a jerk of at most
4 j, which n = 8 keeps below the limit of 5,000 rad/s^3.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import numpy as np

from q2r2_control import Array
from q2r2_franka.limits import JOINTS, PERIOD, TORQUE_RATE

MEANS = 8  # Number of positions of which each command is the mean.
SMOOTHING_DELAY = 0.5 * (MEANS - 1) * PERIOD  # Time by which a mean is behind the path [s].
_RETURN = 0.1  # After lost commands, the arm returns to the path within this time [s].
# This share of the limit of the torque rate is used, because a robot computes the rate from rounded numbers.
_RATE_MARGIN = 0.999


class PositionStream:
    """Computes the positions that are sent to one arm."""

    def __init__(self, q: Array) -> None:
        """Make the stream of an arm that rests at ``q`` (7,) [rad]."""
        self._path = deque([q] * MEANS, maxlen=MEANS)
        self._means = deque([q] * 3, maxlen=3)  # The last three means.
        self._robot = [q] * 3  # The robot's last three positions before the last command.
        self._sent = q  # The last command.
        # The coefficients (6, 7) of the polynomial by which the difference between robot and path goes to zero. Its
        # variable is the time since the polynomial began [s].
        self._difference = np.zeros((6, JOINTS))
        self._since = _RETURN

    def next(self, path: Sequence[Array], held: Array) -> Array:
        """Return the position to send now (7,) [rad].

        Args:
            path: Positions on the path since the last call, which are 1 ms apart. If there are several, the robot got
                no command in the periods of all positions before the last one.
            held: The robot's own last position (7,) [rad], as its newest state reports it.
        """
        self._robot, was_dropped = robot_positions(self._robot, self._sent, len(path), held)
        for q in path[:-1]:
            self._advance(q)
        if was_dropped or len(path) > 1:
            self._begin_return()
        self._sent = self._advance(path[-1]) + self._along(self._since)
        return self._sent

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
        d = [position - mean for position, mean in zip(self._robot, self._means, strict=True)]
        acceleration = (d[2] - 2.0 * d[1] + d[0]) / PERIOD**2
        velocity = (d[2] - d[1]) / PERIOD + 0.5 * PERIOD * acceleration
        T = _RETURN
        ends = np.array([[T**3, T**4, T**5], [3 * T**2, 4 * T**3, 5 * T**4], [6 * T, 12 * T**2, 20 * T**3]])
        left = -np.array([d[2] + velocity * T + 0.5 * acceleration * T**2, velocity + acceleration * T, acceleration])
        self._difference = np.vstack([d[2], velocity, 0.5 * acceleration, np.linalg.solve(ends, left)])
        self._since = 0.0


def robot_positions(before: list[Array], sent: Array, periods: int, held: Array) -> tuple[list[Array], bool]:
    """Return the last three positions to which a robot commanded itself, and whether it dropped the last command.

    Args:
        before: Its last three positions before the last command (7,) [rad].
        sent: The last command (7,) [rad].
        periods: Number of periods since the last command was sent. In the first of them, the robot either took the last
            command or dropped it. In the other periods, it got no command.
        held: The last position that the robot reports (7,) [rad].
    """
    if periods == 1 and np.array_equal(sent, held):
        return [*before[1:], sent], False  # This usual case needs hardly any time.
    if_taken, if_dropped = _continued([*before[1:], sent], periods - 1), _continued(before, periods)
    was_dropped = bool(np.abs(if_dropped[-1] - held).max() < np.abs(if_taken[-1] - held).max())
    return (if_dropped if was_dropped else if_taken), was_dropped


def _continued(positions: list[Array], periods: int) -> list[Array]:
    """Return the robot's last three positions after ``periods`` without a command, in which it goes on by itself.

    It keeps its last acceleration. ``positions`` are its three positions before these periods (7,) [rad].
    """
    for _ in range(periods):
        oldest, before, newest = positions
        positions = [before, newest, 3.0 * newest - 3.0 * before + oldest]
    return positions


class TorqueStream:
    """Computes the torques that are sent to one arm."""

    def __init__(self, limit: Array) -> None:
        """``limit`` is the greatest absolute torque of each joint (7,) [Nm]."""
        self._limit, self._sent = limit, np.zeros(JOINTS)

    def next(self, wanted: Array, held: Array) -> Array:
        """Return the torques to send now (7,) [Nm]: as near to ``wanted`` as the limits allow.

        The torque may change only by the limit of one period, even after periods without a command, because the robot
        keeps the last torque that it took. The robot drops a late command, so ``held`` can be older than the last
        command. The result therefore differs by at most one change from ``held``, and from the last command.

        Args:
            wanted: The torques of the impedance (7,) [Nm].
            held: The torques that the robot took last (7,) [Nm], as its newest state reports them.
        """
        change = _RATE_MARGIN * TORQUE_RATE * PERIOD
        held = np.clip(held, self._sent - change, self._sent + change)
        low, high = np.maximum(self._sent, held) - change, np.minimum(self._sent, held) + change
        self._sent = np.clip(np.clip(wanted, -self._limit, self._limit), low, high)
        return self._sent
