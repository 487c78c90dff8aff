"""The torque that a commanded stop asks of the joints, against their limits.

The controller promises stops in which every joint j decelerates at its limit a_j, whatever the torque. Joints that come
from a low speed may do so with any signs, so joint i is asked for at most

    |g_i(q)| + sum_j |M_ij(q)| a_j

which the signs of M's row, turned to gravity's, do ask. It is inverse dynamics at v = 0, rotors included; Coriolis
torques and friction are not counted. Where gravity alone is too much, the model or the posture is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


@dataclass(frozen=True, slots=True)
class WorstTorque:
    """Where joints of one arm are asked for most, in relation to what they have, and how often for more than that."""

    share_over: float  # of postures where some joint is asked for more than it has
    joint: str  # that is asked for most
    ratio: float  # of that torque to the joint's limit
    posture: tuple[float, ...]  # of the arm's joints, from base to tip, where that is [rad]


@dataclass(frozen=True, slots=True)
class JointTorque:
    """The most that one joint is asked for, in relation to its torque limit."""

    joint: str
    acceleration: float  # at which it stops [rad/s^2]
    gravity: float  # alone
    stop: float  # gravity and a full stop


@dataclass(frozen=True, slots=True)
class StopTorque:
    """Torque that a full stop of one arm asks for, over random postures inside the position limits."""

    arm: str
    joints: tuple[JointTorque, ...]  # from base to tip
    postures: int
    seed: int  # of the random postures
    stop: WorstTorque  # gravity and a full stop
    gravity: WorstTorque  # gravity alone
    bearable: float  # share of all these decelerations that asks no joint for more than it has in any of the postures


def joints_that_cannot_hold(robot: Robot, q: Array) -> dict[str, tuple[float, float]]:
    """Joints that gravity at ``q`` (nv,) asks for more than they have: the torque, and the joint's limit [Nm or N]."""
    gravity = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))
    over = np.flatnonzero(gravity > robot.torque_limit)
    return {robot.joint_names[j]: (float(gravity[j]), float(robot.torque_limit[j])) for j in over}


def stop_torques(robot: Robot, acceleration: Array, postures: int = 5000, seed: int = 0) -> tuple[StopTorque, ...]:
    """One :class:`StopTorque` an arm, for decelerations (nv,) [rad/s^2] of the joints."""
    random, data = np.random.default_rng(seed), robot.model.createData()
    samples = random.uniform(robot.position_lower, robot.position_upper, (postures, robot.model.nv))
    gravity, inertial = np.empty_like(samples), np.empty_like(samples)  # [Nm]
    for i, q in enumerate(samples):
        upper = np.triu(pin.crba(robot.model, data, q))
        inertial[i] = np.abs(upper + np.triu(upper, 1).T) @ acceleration
        gravity[i] = np.abs(pin.computeGeneralizedGravity(robot.model, data, q))
    bearable = (robot.torque_limit - gravity) / inertial
    return tuple(
        StopTorque(
            arm=name,
            joints=tuple(
                JointTorque(
                    joint=robot.joint_names[j],
                    acceleration=float(acceleration[j]),
                    gravity=float(gravity[:, j].max() / robot.torque_limit[j]),
                    stop=float((gravity[:, j] + inertial[:, j]).max() / robot.torque_limit[j]),
                )
                for j in arm.joints
            ),
            postures=postures,
            seed=seed,
            stop=_worst(robot, arm.joints, gravity + inertial, samples),
            gravity=_worst(robot, arm.joints, gravity, samples),
            bearable=max(float(bearable[:, arm.joints].min()), 0.0),
        )
        for name, arm in robot.arms.items()
    )


def _worst(robot: Robot, joints: np.ndarray, torques: Array, samples: Array) -> WorstTorque:
    ratio = (torques / robot.torque_limit)[:, joints]
    worst, k = np.unravel_index(ratio.argmax(), ratio.shape)
    return WorstTorque(
        share_over=float((ratio > 1.0).any(axis=1).mean()),
        joint=robot.joint_names[joints[k]],
        ratio=float(ratio[worst, k]),
        posture=tuple(samples[worst, joints].tolist()),
    )
