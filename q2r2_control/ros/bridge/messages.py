"""Conversion between ROS messages and the dataclasses of ``types.py``, in which times are receipt times [s]."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator, Mapping, Sequence
from functools import lru_cache
from itertools import islice
from typing import Any

import numpy as np
import pinocchio as pin
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Pose, PoseStamped, Twist, TwistStamped, Vector3
from quest2ros.msg import OVR2ROSInputs
from sensor_msgs.msg import JointState

from q2r2_control.inputs.messages import HandPose, HandTwist
from q2r2_control.recording.messages import measured
from q2r2_control.ros.bridge.wire import JointNumbers, Template, read_pose
from q2r2_control.types import QUEST_CONTROLS, Array, HandInputs, RobotState

_UNIT = 1e-3  # Allowed error of a quaternion's norm.
_OLDEST = 0.1  # A message waits only until the next tick. If it seems to be older than this, the clock was set [s].


def ended_topic(target_topic: str) -> str:
    """Return the topic on which the sender of targets ends a stream, because the operator has paused the arm."""
    return f"{target_topic}/ended"


def seconds(stamp: Time) -> float:
    """Return a message's stamp by its sender's clock [s]."""
    return float(stamp.sec) + 1e-9 * float(stamp.nanosec)


def nanoseconds(stamp: Time) -> int:
    return int(stamp.sec) * 1_000_000_000 + int(stamp.nanosec)


def age(info: Mapping[str, Any]) -> float:
    """Return the time since the middleware received a message [s]. A subscription passes ``info`` with the message."""
    return min(max((time.time_ns() - int(info["received_timestamp"])) * 1e-9, 0.0), _OLDEST)


def delay(info: Mapping[str, Any]) -> float:
    """Return the travel time of a message [s] by the clocks of both hosts; NaN if the middleware does not know it."""
    sent, received = int(info["source_timestamp"]), int(info["received_timestamp"])
    return (received - sent) * 1e-9 if sent and received else math.nan


def time_message(t: float) -> Time:
    """Return ``t`` [s] as a stamp, which is never negative."""
    whole, part = divmod(max(t, 0.0), 1.0)
    return Time(sec=int(whole), nanosec=min(round(part * 1e9), 999_999_999))


def stamped_pose(pose: pin.SE3, frame: str, t: float) -> PoseStamped:
    """Return the message of a pose in ``frame`` at ``t`` [s], with a unit quaternion x y z w."""
    return _stamped(pose.translation, pin.Quaternion(pose.rotation).normalized().coeffs(), frame, t)


def twist_stamped(linear: Array, angular: Array, frame: str, t: float) -> TwistStamped:
    """Return the message of a velocity ``linear`` (3,) [m/s] and ``angular`` (3,) [rad/s] in the axes of ``frame``."""
    message = TwistStamped()
    message.header.frame_id, message.header.stamp = frame, time_message(t)
    for vector, values in ((message.twist.linear, linear), (message.twist.angular, angular)):
        vector.x, vector.y, vector.z = values.tolist()
    return message


def _stamped(position: Array, quaternion: Array, frame: str, t: float) -> PoseStamped:
    message = PoseStamped()  # The message is filled in place, because making its parts takes twice as long.
    p, o = message.pose.position, message.pose.orientation
    p.x, p.y, p.z = position.tolist()
    o.x, o.y, o.z, o.w = quaternion.tolist()
    message.header.frame_id, message.header.stamp = frame, time_message(t)
    return message


def pose_of(message: Pose) -> pin.SE3 | None:
    """Return the pose of a message with a normalised quaternion; None if its numbers are no finite pose."""
    p, o = message.position, message.orientation
    return pose_of_numbers((p.x, p.y, p.z, o.x, o.y, o.z, o.w))


def is_pose(numbers: Sequence[float]) -> bool:
    """Return whether a position and a quaternion x y z w are finite, and the quaternion is a rotation."""
    # A sum or a norm with NaN or infinity in it is not finite.
    return math.isfinite(sum(numbers[:3])) and abs(math.hypot(*numbers[3:]) - 1.0) <= _UNIT


def pose_of_numbers(numbers: Sequence[float]) -> pin.SE3 | None:
    """Return the pose of a position and a quaternion x y z w; None if the numbers are no finite pose."""
    if not is_pose(numbers):
        return None
    x, y, z, a, b, c, w = numbers
    length = math.hypot(a, b, c, w)
    return pin.XYZQUATToSE3((x, y, z, a / length, b / length, c / length, w / length))


def hand_pose(message: PoseStamped | bytes) -> HandPose:
    """Return a hand's pose, unchecked; raises SerdeError for bytes that are no PoseStamped."""
    stamp, frame, numbers = read_pose(message)
    values = np.array(numbers)
    return HandPose(values[:3], values[3:], stamp * 1e-9, frame)


def pose_template(frame: str) -> Template:
    """Return the template of a PoseStamped in ``frame``. Its numbers are a position and a quaternion x y z w."""

    def make(numbers: Iterator[float], stamp: Any) -> PoseStamped:
        message = PoseStamped()
        p, o = message.pose.position, message.pose.orientation
        p.x, p.y, p.z, o.x, o.y, o.z, o.w = islice(numbers, 7)
        message.header.frame_id, message.header.stamp = frame, stamp
        return message

    return Template(make, Time())


def fill_pose(template: Template, pose: pin.SE3, t: float) -> bytes:
    """Return the serialized message of a pose at ``t`` [s], with the contents of :func:`stamped_pose`."""
    x, y, z, a, b, c, w = pin.SE3ToXYZQUATtuple(pose)
    length = math.hypot(a, b, c, w)
    return template.fill((x, y, z, a / length, b / length, c / length, w / length), t)


def joint_state_template(names: Sequence[str], q: bool = True, v: bool = True, tau: bool = True) -> Template:
    """Return the template of a JointState. It has positions if ``q``, velocities if ``v``, and torques if ``tau``."""

    def make(numbers: Iterator[float], stamp: Any) -> JointState:
        fields = [list(islice(numbers, len(names))) if given else [] for given in (q, v, tau)]
        message = JointState(name=list(names), position=fields[0], velocity=fields[1], effort=fields[2])
        message.header.stamp = stamp
        return message

    return Template(make, Time())


def hand_twist(message: Twist) -> HandTwist:
    """Return a hand's velocity, unchecked."""
    return HandTwist(*(np.array([vector.x, vector.y, vector.z]) for vector in (message.linear, message.angular)))


def hand_twist_message(twist: HandTwist) -> Twist:
    linear, angular = (Vector3(x=v[0], y=v[1], z=v[2]) for v in (twist.linear.tolist(), twist.angular.tolist()))
    return Twist(linear=linear, angular=angular)


def hand_inputs(message: OVR2ROSInputs) -> HandInputs:
    return HandInputs(**{name: getattr(message, name) for name in QUEST_CONTROLS.names})


def inputs_message(inputs: HandInputs) -> OVR2ROSInputs:
    return OVR2ROSInputs(**{name: getattr(inputs, name) for name in QUEST_CONTROLS.names})


def joint_state_message(names: Sequence[str], q: Array, v: Array, tau: Array, t: float) -> JointState:
    """Return a message with joint positions [rad], velocities [rad/s] and torques [Nm] at ``t`` [s]."""
    message = JointState(name=list(names), position=q.tolist(), velocity=v.tolist(), effort=tau.tolist())
    message.header.stamp = time_message(t)
    return message


def robot_state(message: JointState | JointNumbers, names: Sequence[str], t: float) -> RobotState | str:
    """Return the state in the order of ``names``, received at ``t`` [s], or the fault of the message in one line.

    Other joints in the message are ignored. Velocities and torques are zero if all of them are missing, or if they are
    not measured, see :func:`measured`.
    """
    order = order_of(tuple(message.name), tuple(names))
    if isinstance(order, str):
        return order
    values = []
    for field, required in (("position", True), ("velocity", False), ("effort", False)):
        numbers = np.asarray(getattr(message, field), dtype=np.float64)
        if len(numbers) == 0 and not required:
            values.append(np.zeros(len(names)))
            continue
        if len(numbers) != len(message.name):
            return f"{len(numbers)} {field} values for {len(message.name)} joints"
        numbers = numbers[order]
        if not math.isfinite(sum(numbers.tolist())):  # If the sum is finite, all numbers are finite.
            numbers = measured(field, numbers)
            if not np.isfinite(numbers).all():
                return f"{field} of {names[int(np.argmin(np.isfinite(numbers)))]} is not finite"
        values.append(numbers)
    return RobotState(q=values[0], v=values[1], tau=values[2], tau_external=None, stamp=t)


@lru_cache(maxsize=64)
def called_otherwise(names: tuple[str, ...], given: tuple[str, ...], others: tuple[str, ...]) -> dict[str, str]:
    """Return the sender's name for each of an arm's joints, among the ``given`` names; {} unless all are found.

    A joint left_A1 may be lbr_A1 or A1 for the sender. It is found by its last part if only one given name has this
    part. It may also be left_joint_1. It is then found by its number: in exactly one group of given names that differ
    only in the numbers at their ends, these numbers must be those of the arm's joints. If a given name begins with one
    of ``others``, which are the other arms, no name is used.
    """
    if any(name.startswith(f"{other}_") for name in given for other in others):
        return {}
    ends = {name: name.partition("_")[2] or name for name in names}
    found = {name: [one for one in given if one == end or one.endswith(f"_{end}")] for name, end in ends.items()}
    if all(len(ones) == 1 for ones in found.values()):
        return {name: ones[0] for name, ones in found.items()}
    numbers, alike = [_stem_and_number(name)[1] for name in names], dict[str, dict[str, str]]()
    for one in given:
        stem, number = _stem_and_number(one)
        alike.setdefault(stem, {})[number] = one
    whole = [ones for ones in alike.values() if ones.keys() == set(numbers) and len(ones) == len(names)]
    return {name: whole[0][number] for name, number in zip(names, numbers, strict=True)} if len(whole) == 1 else {}


def _stem_and_number(name: str) -> tuple[str, str]:
    stem = name.rstrip("0123456789")
    return stem, name[len(stem) :]


@lru_cache(maxsize=64)  # Results are kept, because publishers send the same names again and again.
def order_of(given: tuple[str, ...], names: tuple[str, ...]) -> Array | str:
    """Return the index of each of ``names`` in ``given``, or one line that says what is wrong with ``given``."""
    if len(set(given)) != len(given):
        return "a joint is named twice"
    if missing := [name for name in names if name not in given]:
        return f"no joint {missing[0]}" + (f" and {len(missing) - 1} more" if len(missing) > 1 else "")
    return np.array([given.index(name) for name in names], dtype=np.intp)
