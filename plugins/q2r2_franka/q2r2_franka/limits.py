"""The published limits of the Franka Research 3.

Source: ``include/franka/rate_limiting.h`` of libfranka 0.21 without its margin of 0.001, and Franka's interface
specification, https://frankarobotics.github.io/docs/control_parameters.html#limits-for-franka-research-3.
"""

from __future__ import annotations

import numpy as np

from q2r2_control import Array

JOINTS = 7
PERIOD = 0.001  # Time between two states of a robot, and between two commands [s].
LOWER = np.array([-2.7501, -1.7918, -2.9065, -3.0481, -2.8101, 0.54092, -3.0196])  # Least positions [rad].
UPPER = np.array([2.7501, 1.7918, 2.9065, -0.1458, 2.8101, 4.5205, 3.0196])  # Greatest positions [rad].
VELOCITY = np.array([2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26])  # Greatest velocities [rad/s].
ACCELERATION = 10.0  # Limit of every joint [rad/s^2].
JERK = 5000.0  # Limit of every joint [rad/s^3].
TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])  # Greatest torques [Nm].
TORQUE_RATE = 1000.0  # Limit of every joint's torque rate [Nm/s].
# At the distance d from a position limit, a joint's velocity towards this limit is at most sqrt(_SLOPE d) - _OFFSET.
_OFFSET = np.array([0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35])  # [rad/s]
_SLOPE = np.array([12.0, 5.17, 7.00, 8.00, 34.0, 11.0, 34.0])  # [rad/s^2]


def velocity_limits(q: Array) -> tuple[Array, Array]:
    """Return the least and the greatest permitted velocity of each joint at ``q`` (7,) [rad], both (7,) [rad/s]."""
    room = np.sqrt(np.maximum(_SLOPE * (q - LOWER), 0.0)), np.sqrt(np.maximum(_SLOPE * (UPPER - q), 0.0))
    down, up = (np.clip(each - _OFFSET, 0.0, VELOCITY) for each in room)
    return -down, up
