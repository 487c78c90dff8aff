"""Records the joint states of a cell: how fast and how smoothly the arms moved, and when they came to rest."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Any, NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control import Robot
from q2r2_control.types import Array
from tests.ros.waiting import wait_until

SLOW = 0.05  # 3 % of a joint's limit: the arm still settles, but no longer follows [rad/s]
REST = 0.01  # [rad/s]
REST_TIME = 0.3  # that joints have to be slower than that [s]
SPEED_WINDOW = 0.2  # [s]


class Joints(NamedTuple):
    """One joint state."""

    t: float  # of its receipt, on this machine's steady clock [s]
    q: Array
    v: Array
    stamp: float  # of the message [s]


class Stop(NamedTuple):
    """How all joints came to rest after a fault."""

    speed: float  # of the fastest joint at the fault [rad/s]
    slow: float  # from the fault until all joints are slow for good [s]


class JointRecorder:
    """The joint states of all arms of ``robot``, as they are received."""

    def __init__(self, robot: Robot) -> None:
        self.states: list[Joints] = []
        self._robot = robot

    def subscribe(self, node: Any, qos: Any = 100) -> None:
        """Record ``/joint_states`` from now on."""
        from sensor_msgs.msg import JointState

        def on_joint_state(message: JointState) -> None:
            stamp = message.header.stamp.sec + 1e-9 * message.header.stamp.nanosec
            self.take(message.name, message.position, message.velocity, time.monotonic(), stamp)

        node.create_subscription(JointState, "/joint_states", on_joint_state, qos)

    def take(self, names: Sequence[str], q: Sequence[float], v: Sequence[float], t: float, stamp: float = 0.0) -> None:
        """Append one state; other joints in it are ignored, and so is a state without all joints of the arms."""
        place = {name: index for index, name in enumerate(names)}
        if all(name in place for name in self._robot.joint_names):
            order = [place[name] for name in self._robot.joint_names]
            velocity = np.array(v)[order] if len(v) else np.zeros(len(order))
            self.states.append(Joints(t, np.array(q)[order], velocity, stamp))

    @property
    def q(self) -> Array:
        """The newest positions [rad]."""
        return self.states[-1].q

    def tool(self, arm: str) -> pin.SE3:
        """Where a tool is now."""
        return self._robot.tool_pose(self.q, arm)

    def since(self, t: float) -> list[Joints]:
        """All states received after ``t`` [s]."""
        states = self.states[:]  # another thread appends
        first = len(states)
        while first and states[first - 1].t > t:
            first -= 1
        return states[first:]

    def speeds(self, duration: float) -> Array:
        """Greatest speed of each joint in the last ``duration`` [s]."""
        recent = self.since(time.monotonic() - duration)
        return np.max([np.abs(state.v) for state in recent], axis=0) if recent else np.zeros(self._robot.model.nv)

    def fastest(self, since: float) -> float:
        """Greatest speed of any joint since [s], as a mean over a window [rad/s].

        The window is longer than what a simulated robot that had no processor time catches up with, and shorter than a
        jump to an old target would take.
        """
        states, first, fastest = self.since(since), 0, 0.0
        for state in states:
            while state.stamp - states[first].stamp > SPEED_WINDOW:
                change = float(np.abs(state.q - states[first].q).max())
                fastest = max(fastest, change / (state.stamp - states[first].stamp))
                first += 1
        return fastest

    def farthest_from(self, posture: Array, since: float) -> float:
        """How far any joint has been from ``posture`` [rad]."""
        return max(float(np.abs(state.q - posture).max()) for state in self.since(since))

    def tool_farthest_from(self, posture: Array, since: float) -> float:
        """How far any tool has been from where it is in ``posture`` [m]."""
        states = self.since(since)
        return max(self._tool_motion(arm, posture, states) for arm in self._robot.arms)

    def wait_for_rest(self) -> Array:
        """Wait until no joint has moved for a while; the positions [rad]."""

        def rests() -> bool:
            recent = [state.q for state in self.since(time.monotonic() - 0.4)]
            return len(recent) >= 10 and float(np.ptp(recent, axis=0).max()) < 5e-4

        wait_until(rests, "the arms are at rest")
        return self.q

    def stop_after(self, fault: float) -> Stop:
        """Wait until all joints rest after a fault at ``fault`` [s]."""

        def last(speed: float) -> float:
            """When any joint was last faster than that [s]."""
            return max((state.t for state in self.since(fault) if np.abs(state.v).max() > speed), default=fault)

        wait_until(lambda: self.states[-1].t - last(REST) > REST_TIME, "all joints rest")
        before = [state for state in self.states if state.t <= fault][-1]
        return Stop(float(np.abs(before.v).max()), last(SLOW) - fault)

    @contextmanager
    def tools_rest(self, within: float, what: str) -> Iterator[None]:
        """Asserts that no tool is farther than ``within`` [m] from where it was, at any joint state meanwhile."""
        first = self.states[-1]
        yield
        for arm in self._robot.arms:
            moved = self._tool_motion(arm, first.q, self.since(first.t))
            assert moved <= within, f"{arm} moved by {moved:.4f} m while {what}"

    def _tool_motion(self, arm: str, posture: Array, states: list[Joints]) -> float:
        start = self._robot.tool_pose(posture, arm).translation
        tools = [self._robot.tool_pose(state.q, arm).translation for state in states]
        return max((float(np.linalg.norm(tool - start)) for tool in tools), default=0.0)
