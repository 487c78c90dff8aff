"""Poses of frames in other frames are computed from the newest transforms."""

from __future__ import annotations

import math
import time
from typing import Any

import numpy as np
import pinocchio as pin
import pytest

from tests.ros.conftest import need_ros, spun_node

need_ros()


from geometry_msgs.msg import TransformStamped
from rclpy.serialization import serialize_message
from tf2_msgs.msg import TFMessage

from q2r2_control.events import Reason
from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.bridge.frames import FrameListener, FrameTree, ReadTransform, read_transforms
from q2r2_control.ros.reasons import RosReason
from tests.ros.arm_rig import stamped_transform
from tests.ros.processes import wait_until

A = pin.SE3(pin.exp3(np.array([0.3, -1.0, 0.2])), np.array([1.0, 2.0, -0.5]))
B = pin.SE3(pin.exp3(np.array([-0.7, 0.1, 2.0])), np.array([0.2, -0.4, 0.9]))
C = pin.SE3(pin.exp3(np.array([1.1, 0.4, -0.3])), np.array([-0.6, 0.1, 0.3]))


def read(transform: TransformStamped) -> ReadTransform:
    return read_transforms(serialize_message(TFMessage(transforms=[transform])))[0]


@pytest.fixture
def tree() -> FrameTree:
    made = FrameTree()
    made.set(read(stamped_transform("world", "mount", A)), math.inf)
    made.set(read(stamped_transform("mount", "/tool", B)), 3.0)
    made.set(read(stamped_transform("world", "table", C)), 2.0)
    return made


CHAINS = {
    "up the chain": ("tool", "world", A * B, 3.0),
    "down the chain": ("world", "tool", (A * B).inverse(), 3.0),
    "across branches, as old as the oldest": ("tool", "table", C.inverse() * A * B, 2.0),
    "over what is static, never old": ("mount", "world", A, math.inf),
    "to itself": ("tool", "tool", pin.SE3.Identity(), math.inf),
}


@pytest.mark.parametrize(("frame", "within", "pose", "received"), CHAINS.values(), ids=CHAINS)
def test_the_pose_of_a_frame_in_another_frame_is_found_through_a_chain_of_transforms(
    frame: str, within: str, pose: pin.SE3, received: float, tree: FrameTree
) -> None:
    placement = tree.find(frame, within)
    assert placement is not None
    np.testing.assert_allclose(placement.pose.homogeneous, pose.homogeneous, atol=1e-12)
    assert placement.received == received


def test_unconnected_frames_are_not_found_even_if_transforms_form_a_ring(tree: FrameTree) -> None:
    assert tree.find("tool", "elsewhere") is None
    tree.set(read(stamped_transform("tool", "world", A)), 4.0)
    assert tree.find("tool", "elsewhere") is None


@pytest.mark.parametrize("bad", [math.nan, math.inf, 0.0])
def test_an_invalid_transform_is_ignored(bad: float, tree: FrameTree) -> None:
    message = stamped_transform("mount", "tool", C)
    rotation = message.transform.rotation
    rotation.x = rotation.y = rotation.z = rotation.w = bad
    tree.set(read(message), 9.0)
    placement = tree.find("tool", "mount")
    assert placement is not None
    np.testing.assert_allclose(placement.pose.homogeneous, B.homogeneous, atol=1e-12)


def test_a_message_with_a_name_that_is_not_text_is_dropped_and_the_next_message_is_read(node: Any) -> None:
    dropped: list[str] = []
    # A FrameListener calls this method, which the package's nodes have.
    node.drop = lambda topic, text: dropped.append(topic)
    listener = FrameListener(node)
    publisher = node.create_publisher(TFMessage, "/tf_static", LATCHED_QOS)
    good = serialize_message(TFMessage(transforms=[stamped_transform("mount", "tool", C)]))
    wait_until(lambda: publisher.get_subscription_count() > 0, "the listener is found")
    publisher.publish(good.replace(b"tool", b"\xe9ool"))
    publisher.publish(good)
    wait_until(lambda: listener.tree.find("tool", "mount") is not None, "the good one is heard")
    assert dropped == ["/tf_static"]


def send_from(node: Any, name: str, pose: pin.SE3, counted: int) -> Any:
    publisher = node.create_publisher(TFMessage, "/tf", 10)
    for _ in range(counted):
        publisher.publish(TFMessage())
    message = TFMessage(transforms=[stamped_transform("world", name, pose)])
    return node.create_timer(0.01, lambda: publisher.publish(message))


@pytest.mark.parametrize(("second", "disagree"), [(A, False), (C, True)], ids=["the same pose", "another pose"])
def test_two_publishers_of_a_frame_are_a_conflict_only_if_they_disagree(
    second: pin.SE3, disagree: bool, domain: int, node: Any
) -> None:
    node.now = 0.0  # A FrameListener needs this attribute, which the package's nodes have.
    listener = FrameListener(node)
    disputed = Reason.of(RosReason.FRAME_DISPUTED, frame="mount", publishers="/another and /test")
    timers = [send_from(node, "mount", A, 300), send_from(node, "elsewhere", B, 0)]
    wait_until(lambda: listener.tree.find("mount", "world") is not None, "one publisher is heard")
    assert listener.conflict("mount") is None
    with spun_node(domain, "another") as another:
        send_from(another, "mount", second, 0)
        if disagree:
            wait_until(lambda: listener.conflict("mount") == disputed, "they disagree")
            assert listener.conflict("elsewhere") is None
        else:
            time.sleep(1.0)
            assert listener.conflict("mount") is None
    wait_until(lambda: listener.conflict("mount") is None, "it is over when one ends")
    for timer in timers:
        node.destroy_timer(timer)


def test_a_listener_keeps_only_frames_that_are_needed_and_notices_a_new_parent(node: Any) -> None:
    node.now = 0.0
    listener = FrameListener(node)
    publisher = node.create_publisher(TFMessage, "/tf", 10)
    sent = [
        stamped_transform("world", "arm", A),
        stamped_transform("arm", "tool", B),
        stamped_transform("arm", "lamp", C),
    ]

    def found(frame: str, pose: pin.SE3) -> bool:
        publisher.publish(TFMessage(transforms=sent))
        placement = listener.tree.find(frame, "world")
        return placement is not None and placement.pose.isApprox(pose, 1e-9)

    wait_until(lambda: found("tool", A * B), "it is found")
    assert not listener.tree.wants("lamp")
    wait_until(lambda: found("lamp", A * C), "a frame that nobody had asked for is found too")
    sent[:] = [stamped_transform("world", "cart", C), stamped_transform("cart", "arm", A), *sent[1:]]
    wait_until(lambda: found("tool", C * A * B), "it hangs on another frame")
