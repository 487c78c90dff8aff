"""A controller that takes velocities gets the velocities of the guarded target, and zero if the arm should rest."""

from __future__ import annotations

import time
from collections.abc import Iterator
from queue import Queue
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.types import Array
from tests.ros.conftest import need_ros
from tests.ros.processes import subscribed, wait_until

need_ros()

from geometry_msgs.msg import TwistStamped

from q2r2_control.ros.nodes.arm_controllers import LeftArmController
from q2r2_control.teleop.arm_states import ArmState

PERIOD = 0.01  # Period of the node's ticks [s].
BASE = pin.SE3(pin.rpy.rpyToMatrix(0.0, 0.0, np.pi / 2.0), np.array([0.0, 0.5, 0.0]))  # Pose in the world frame.
TOOL = pin.SE3(np.eye(3), np.array([0.5, 0.0, 0.4]))


class Driven:
    """The output of a node that is not spun. The test sets the time of each step."""

    def __init__(self, node: Any, context: Any) -> None:
        self.arm = LeftArmController(preset="twist", ctrl_prefix="/robot/left_ctrl", context=context)
        self.output = self.arm.outputs.first
        assert self.output.topic == "/robot/left_ctrl/teleop_twist"
        self._taken: Queue[TwistStamped] = subscribed(node, TwistStamped, self.output.topic)
        self.now, self.at = 100.0, TOOL
        self._newest: tuple[Array, Array] = (np.full(3, np.nan), np.full(3, np.nan))

    def step(self, target: pin.SE3 | None, base: pin.SE3 | None = BASE, state: ArmState = ArmState.ENGAGED) -> None:
        self.now += PERIOD
        self.output.step(target, self.at, base, self.now, time.monotonic(), state=state)
        time.sleep(0.5 * PERIOD)  # Acknowledgements take real time.

    def move(self, velocity: Array, turn: Array) -> None:
        """Let the target move on for one tick, and the tool with it."""
        rotation = pin.exp3(turn * PERIOD) @ self.at.rotation
        self.at = pin.SE3(rotation, self.at.translation + velocity * PERIOD)
        self.step(self.at)

    def newest(self) -> tuple[Array, Array]:
        """Return the newest velocity that the receiver has taken: linear [m/s] and angular [rad/s]."""
        while self._taken.qsize():
            message = self._taken.get()
            assert message.header.frame_id == "world"
            linear, angular = message.twist.linear, message.twist.angular
            self._newest = (
                np.array([linear.x, linear.y, linear.z]),
                np.array([angular.x, angular.y, angular.z]),
            )
        return self._newest

    def stands(self) -> bool:
        return not np.any(self.newest())


@pytest.fixture
def driven(node: Any, context: Any) -> Iterator[Driven]:
    made = Driven(node, context)

    def ready() -> bool:
        made.now += PERIOD
        made.output.take_fault(made.now)
        return made.output.unready is None

    def begins() -> bool:
        made.step(TOOL)
        return made.stands()

    wait_until(ready, "the receiver is known")
    wait_until(begins, "velocities come")
    yield made
    made.arm.destroy_node()


VELOCITY, TURN = np.array([0.1, 0.0, 0.05]), np.array([0.0, 0.0, 0.4])
IN_BASE = np.array([0.0, -0.1, 0.05])  # The axes of the base are turned to the left.


def moving(driven: Driven) -> None:
    """Let the target move on until the receiver has taken its velocity."""

    def taken() -> bool:
        driven.move(VELOCITY, TURN)
        linear, angular = driven.newest()
        return np.allclose(linear, IN_BASE, atol=1e-6) and np.allclose(angular, TURN, atol=1e-6)

    wait_until(taken, "the velocity is that of the target", driven.newest)


def test_the_receiver_gets_the_velocity_of_the_target_in_the_axes_of_the_base(driven: Driven) -> None:
    moving(driven)


def test_after_a_jump_of_the_target_the_velocity_stays_within_the_limits_of_the_guard(driven: Driven) -> None:
    limits = driven.output.guard.settings
    far = pin.SE3(np.eye(3), TOOL.translation + np.array([1000.0, 0.0, 0.0]))
    speeds = [0.0]

    def taken() -> bool:
        driven.step(far)
        speeds.append(float(np.linalg.norm(driven.output.guard.velocity[0])))
        return bool(np.linalg.norm(driven.newest()[0]) > limits.max_velocity - 1e-6)

    wait_until(taken, "the receiver gets the largest velocity")
    assert max(speeds) <= limits.max_velocity + 1e-9
    assert np.diff(speeds).max() <= limits.max_acceleration * PERIOD + 1e-9


@pytest.mark.parametrize("state", [ArmState.PAUSED, ArmState.LOST])
def test_a_paused_or_lost_arm_brakes_and_then_gets_velocity_zero_as_long_as_it_holds(
    state: ArmState, driven: Driven
) -> None:
    moving(driven)
    driven.step(None, state=state)
    assert 0.0 < np.linalg.norm(driven.output.guard.velocity[0]) < np.linalg.norm(VELOCITY)

    def stands() -> bool:
        driven.step(None, state=state)
        return driven.stands()

    wait_until(stands, "zero comes", driven.newest)
    sent = driven.output.sent
    for _ in range(5):
        assert stands()
    assert driven.output.sent == sent + 5


def test_velocity_zero_is_sent_at_once_when_the_pose_of_the_base_is_not_known_any_more(driven: Driven) -> None:
    moving(driven)
    driven.step(None, base=None, state=ArmState.LOST)
    wait_until(driven.stands, "zero comes", driven.newest)


def test_velocity_zero_is_sent_at_once_when_the_stream_is_dropped(driven: Driven) -> None:
    moving(driven)
    driven.output.forget(driven.now)
    wait_until(driven.stands, "zero comes", driven.newest)
