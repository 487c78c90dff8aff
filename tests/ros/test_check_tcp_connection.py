"""The live view of both hands, as a process that prints."""

from __future__ import annotations

import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, Processes
from tests.ros.waiting import States, wait_until

need_ros()

NAME = "CheckTCPconnection"
LONG = 2.0 * PATIENCE


@contextmanager
def left_hand_publishing(node: Any) -> Iterator[None]:
    """Pose, inputs and twist of the left hand with numbers of their own, for as long as the context lasts."""
    from geometry_msgs.msg import Point, Pose, PoseStamped, Quaternion, Twist, Vector3
    from quest2ros.msg import OVR2ROSInputs

    pose = PoseStamped(pose=Pose(position=Point(x=1.0, y=2.0, z=-3.0), orientation=Quaternion(w=-1.0)))
    twist = Twist(linear=Vector3(x=0.5), angular=Vector3(z=-0.25))
    inputs = OVR2ROSInputs(button_lower=True, press_index=0.75)
    messages = {"pose": pose, "twist": twist, "inputs": inputs}
    publishers = {name: node.create_publisher(type(m), f"q2r_left_hand_{name}", 10) for name, m in messages.items()}
    timer = node.create_timer(0.02, lambda: [publishers[name].publish(m) for name, m in messages.items()])
    try:
        yield
    finally:
        node.destroy_timer(timer)


def test_it_shows_values_rate_and_age_and_tells_a_timeout(node: Any, processes: Processes) -> None:
    states = States(node, "check_tcp_connection")
    check = processes.start_node(NAME)
    with left_hand_publishing(node):
        check.wait_for("s old: 1.00 2.00 -3.00 m, quaternion 0.00 0.00 0.00 -1.00")
        check.wait_for("held: lower, triggers 0.8 0.0")
        state = states.wait_for("timeout, nothing for 2 s: q2r_right_hand_pose")
        assert state["level"] == "warn"
        assert state["rate_hz"]["q2r_left_hand_pose"] > 0.0
    wait_until(lambda: re.search(r"q2r_left_hand_pose: timeout, \d+ messages", check.output), "a timeout of the pose")
    assert states.wait_for("q2r_left_hand_pose")["level"] == "error"
    assert check.interrupt() == 0


def test_after_its_duration_the_exit_code_says_that_nothing_has_arrived(processes: Processes) -> None:
    assert processes.start_node(NAME, "duration:=2.5").wait(LONG) == 1
