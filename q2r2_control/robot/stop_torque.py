"""Compare the torques that a commanded stop requires with the torque limits of the joints.

The controller promises stops in which every joint j decelerates at its limit a_j, whatever torque this requires. At low
speeds, the decelerations of the joints may have any signs. Joint i therefore requires at most the torque

    |g_i(q)| + sum_j |M_ij(q)| a_j

and reaches it if the signs of M's row agree with the sign of gravity. This is inverse dynamics at v = 0 with rotors.
Coriolis torques and friction are not counted. If gravity alone is too much, the model or the posture is wrong.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


@dataclass(frozen=True, slots=True)
class WorstTorque:
    """The posture in which one arm requires the most torque, relative to the limits of its joints."""

    share_over: float  # Share of the postures in which some joint requires more than its torque limit.
    joint: str  # The joint with the greatest ratio.
    ratio: float  # Ratio of the required torque to the joint's limit.
    posture: tuple[float, ...]  # Positions of the arm's joints in the worst posture, from base to tip [rad].


@dataclass(frozen=True, slots=True)
class JointTorque:
    """The greatest torques that one joint requires, as ratios to its torque limit."""

    joint: str
    acceleration: float  # Deceleration of the stop [rad/s^2].
    gravity: float  # Ratio for gravity alone.
    stop: float  # Ratio for gravity and a full stop.


@dataclass(frozen=True, slots=True)
class StopTorque:
    """The torque that a full stop of one arm requires, over random postures inside the position limits."""

    arm: str
    joints: tuple[JointTorque, ...]  # The joints from base to tip.
    postures: int  # Number of random postures.
    seed: int  # Seed of the random postures.
    stop: WorstTorque  # The worst torque of gravity and a full stop.
    gravity: WorstTorque  # The worst torque of gravity alone.
    # Largest factor for all decelerations with which no joint exceeds its torque limit in any of the postures. It is 0
    # if gravity alone exceeds a limit.
    bearable: float


def joints_that_cannot_hold(robot: Robot, q: Array) -> dict[str, tuple[float, float]]:
    """Return the joints whose torque limit is less than the torque of gravity at ``q`` (nv,).

    The values are the torque of gravity and the joint's limit [Nm or N].
    """
    gravity = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))
    over = np.flatnonzero(gravity > robot.torque_limit)
    return {robot.joint_names[j]: (float(gravity[j]), float(robot.torque_limit[j])) for j in over}


def stop_torques(robot: Robot, acceleration: Array, postures: int = 5000, seed: int = 0) -> tuple[StopTorque, ...]:
    """Return one :class:`StopTorque` for each arm, from random postures.

    Args:
        robot: The robot.
        acceleration: The decelerations of the joints (nv,) [rad/s^2].
        postures: The number of random postures.
        seed: The seed of the random postures.
    """
    random, data = np.random.default_rng(seed), robot.model.createData()
    samples = random.uniform(robot.position_lower, robot.position_upper, (postures, robot.model.nv))
    masses, gravity = np.empty((postures, robot.model.nv, robot.model.nv)), np.empty_like(samples)  # [kg m^2], [Nm]
    for i, q in enumerate(samples):
        masses[i] = pin.crba(robot.model, data, q)
        gravity[i] = pin.computeGeneralizedGravity(robot.model, data, q)
    upper = np.triu(masses)
    inertial, gravity = np.abs(upper + np.triu(upper, 1).transpose(0, 2, 1)) @ acceleration, np.abs(gravity)
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
