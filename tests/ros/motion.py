"""What the arms do, at every joint state: how fast, how abruptly, and whether they stand still."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin
from sensor_msgs.msg import JointState

from q2r2_control import Robot
from tests.ros.processes import PATIENCE

_WINDOW = 0.02  # over which a velocity's change counts [s]


class Moment(NamedTuple):
    """One joint state."""

    t: float  # its stamp [s]
    q: Any
    v: Any


class Motion:
    """Keeps the joint states of all arms."""

    def __init__(self, node: Any, robot: Robot) -> None:
        self._robot, self._data = robot, robot.model.createData()
        self.moments: list[Moment] = []
        node.create_subscription(JointState, "/joint_states", self._on_joint_state, 100)

    def _on_joint_state(self, message: JointState) -> None:
        place = {name: index for index, name in enumerate(message.name)}
        columns = [place[name] for name in self._robot.joint_names]
        stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
        self.moments.append(Moment(stamp, np.array(message.position)[columns], np.array(message.velocity)[columns]))

    def tool(self, arm: str) -> pin.SE3:
        """Where a tool is now."""
        return self._robot.tool_pose(self.moments[-1].q, arm)

    def wait_for_rest(self) -> None:
        """Until no joint has moved for a while."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            before = self.moments[-1].q
            time.sleep(0.15)
            if np.abs(self.moments[-1].q - before).max() < 1e-3:
                return
        raise AssertionError("the arms do not come to rest")

    def wait_for_tool(self, arm: str, position: Any, within: float) -> None:
        """Until an arm's tool has come to a place [m]."""
        deadline = time.monotonic() + PATIENCE
        while (distance := float(np.linalg.norm(self.tool(arm).translation - position))) > within:
            assert time.monotonic() < deadline, f"{arm} stays {distance:.4f} m from where it should be"
            time.sleep(0.02)

    @contextmanager
    def standing_still(self, within: float, what: str) -> Iterator[None]:
        """Asserts that no tool is farther than ``within`` [m] from where it was, at any joint state meanwhile."""
        since = len(self.moments) - 1
        yield
        for arm in self._robot.arms:
            tools = [self._robot.tool_pose(moment.q, arm).translation for moment in self.moments[since:]]
            moved = max(float(np.linalg.norm(tool - tools[0])) for tool in tools)
            assert moved <= within, f"{arm} moved by {moved:.4f} m while {what}"

    def assert_smooth(self, since: int, speed: float, turning: float, acceleration: float) -> None:
        """No tool is faster [m/s], [rad/s], nor changes its velocity faster [m/s^2], at any joint state since."""
        for arm in self._robot.arms:
            moments = self.moments[since:]
            twists = [self._twist(moment, arm) for moment in moments]
            fastest = max(float(np.linalg.norm(twist[:3])) for twist in twists)
            assert fastest <= speed, f"{arm} moved at {fastest:.3f} m/s"
            widest = max(float(np.linalg.norm(twist[3:])) for twist in twists)
            assert widest <= turning, f"{arm} turned at {widest:.3f} rad/s"
            steepest = _steepest([moment.t for moment in moments], [twist[:3] for twist in twists])
            assert steepest <= acceleration, f"{arm} accelerated at {steepest:.2f} m/s^2"

    def _twist(self, moment: Moment, arm: str) -> Any:
        pin.computeJointJacobians(self._robot.model, self._data, moment.q)
        frame = self._robot.arms[arm].frame_id
        return pin.getFrameJacobian(self._robot.model, self._data, frame, pin.LOCAL_WORLD_ALIGNED) @ moment.v


def _steepest(times: list[float], velocities: list[Any]) -> float:
    """Greatest change per time, between moments that are a window apart."""
    steepest, first = 0.0, 0
    for index, t in enumerate(times):
        while times[first] + _WINDOW < t:
            change = float(np.linalg.norm(velocities[index] - velocities[first]))
            steepest = max(steepest, change / (t - times[first]))
            first += 1
    return steepest
