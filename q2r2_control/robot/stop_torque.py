"""What torque a commanded stop asks of the joints, against what they have.

The controller promises stops in which every joint decelerates at its limit a, whatever the torque. Joints that come
from a low speed may do so with any signs, so joint i is asked for at most

    |g_i(q)| + a sum_j |M_ij(q)|

which the signs of M's row, turned to gravity's, do ask. It is inverse dynamics at v = 0, rotors included; a stop from
speed asks for Coriolis torques as well, and friction helps it: neither is counted.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot


@dataclass(frozen=True, slots=True)
class StopTorque:
    """Torque that a full stop of one arm asks for, over random postures inside the position limits."""

    arm: str
    acceleration: float  # of every joint [rad/s^2]
    postures: int
    share_over: float  # of postures where some joint is asked for more than it has
    joint: str  # that is asked for most
    ratio: float  # of that torque to the joint's limit
    posture: tuple[float, ...]  # of the arm's joints, from base to tool, where that is [rad]
    bearable: float  # deceleration that asks no joint for more than it has in any of the postures [rad/s^2]


def stop_torques(robot: Robot, acceleration: float, postures: int = 5000, seed: int = 0) -> tuple[StopTorque, ...]:
    """One :class:`StopTorque` an arm, for decelerations of ``acceleration`` [rad/s^2] of every joint."""
    random, data = np.random.default_rng(seed), robot.model.createData()
    samples = random.uniform(robot.position_lower, robot.position_upper, (postures, robot.model.nv))
    gravity, leverage = np.empty_like(samples), np.empty_like(samples)  # [Nm], [Nm / (rad/s^2)]
    for i, q in enumerate(samples):
        upper = np.triu(pin.crba(robot.model, data, q))
        leverage[i] = np.abs(upper + np.triu(upper, 1).T).sum(axis=1)
        gravity[i] = np.abs(pin.computeGeneralizedGravity(robot.model, data, q))
    ratio = (gravity + acceleration * leverage) / robot.torque_limit
    bearable = (robot.torque_limit - gravity) / leverage
    found = []
    for name, arm in robot.arms.items():
        own = ratio[:, arm.joints]
        worst, k = np.unravel_index(own.argmax(), own.shape)
        found.append(
            StopTorque(
                arm=name,
                acceleration=acceleration,
                postures=postures,
                share_over=float((own > 1.0).any(axis=1).mean()),
                joint=robot.joint_names[arm.joints[k]],
                ratio=float(own[worst, k]),
                posture=tuple(samples[worst, arm.joints].tolist()),
                bearable=max(float(bearable[:, arm.joints].min()), 0.0),
            )
        )
    return tuple(found)
