"""What one arm's node makes of what the other one says; real nodes and real messages, also those that are lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.waiting import eventually

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from q2r2_control.ros.monitoring.arm_link import ArmLink

TIMEOUT = 1.0  # a busy machine must not look like silence [s]
MEANWHILE = 0.3  # time for several signs of life [s]


class End:
    """One arm's node with its end of the link, and all faults that it was told."""

    def __init__(self, node: Any, arm: str) -> None:
        self.node = node
        self.link = ArmLink(node, "robot", arm, "side_by_side", TIMEOUT)
        self.told: list[str] = []

    def listen(self) -> list[str]:
        if (fault := self.link.take_fault()) is not None:
            self.told.append(fault)
        return self.told

    def hears(self, text: str) -> Callable[[], bool]:
        return lambda: any(text in line for line in self.listen())

    def listen_for_a_while(self) -> list[str]:
        """All faults told so far and while several more signs of life come."""
        deadline = time.monotonic() + MEANWHILE
        while time.monotonic() < deadline:
            self.listen()
            time.sleep(0.01)
        return self.told


Make = Callable[[str], End]


@pytest.fixture
def make(domain: int) -> Iterator[Make]:
    """Starts an arm's node; a second one of the same name replaces nothing."""
    with ExitStack() as stack:
        yield lambda arm: End(stack.enter_context(spun_node(domain, f"{arm}_arm")), arm)


@pytest.fixture
def pair(make: Make) -> tuple[End, End]:
    """Two arms that know each other."""
    left, right = make("left"), make("right")
    meet(left, right)
    return left, right


def meet(left: End, right: End) -> None:
    """Until each hears the other: a fault of a paused arm is told to a paused arm, and forgotten."""
    for speaker, hearer in ((left, right), (right, left)):
        speaker.link.report("hello")
        eventually(hearer.hears("hello"), "a fault is heard")
    for end in (left, right):
        end.listen_for_a_while()
        end.told.clear()


def test_a_fault_pauses_the_other_arm_once_however_often_it_is_repeated(pair: tuple[End, End]) -> None:
    left, right = pair
    right.link.engaged()
    left.link.report("the hand jumped")
    eventually(right.hears("the hand jumped"), "the fault is told")
    assert right.listen_for_a_while() == ["linked to left: the hand jumped"]
    right.link.engaged()
    assert right.listen_for_a_while() == ["linked to left: the hand jumped"]
    left.link.report("the hand jumped")
    eventually(lambda: len(right.listen()) == 2, "the same fault once more is another fault")


def test_a_fault_whose_first_messages_are_lost_is_told_by_the_next_ones(make: Make) -> None:
    right = make("right")
    right.link.engaged()
    left = make("left")
    left.link.report("no pose")  # before anybody can have subscribed
    left.link.engaged()  # and its own arm is engaged again at once
    eventually(right.hears("no pose"), "the fault is told")
    assert right.listen_for_a_while() == ["linked to left: no pose"]


def test_messages_that_a_node_had_no_time_to_read_cost_no_fault(domain: int, make: Make) -> None:
    import rclpy
    from rclpy.executors import SingleThreadedExecutor

    left = make("left")
    context = rclpy.Context()
    rclpy.init(context=context, domain_id=domain)
    busy = rclpy.create_node("right_arm", context=context)
    executor = SingleThreadedExecutor(context=context)
    executor.add_node(busy)
    try:
        right = End(busy, "right")
        eventually(lambda: left.node.count_subscribers("/robot/left/link") == 1, "it is subscribed")
        right.link.engaged()
        left.link.report("no pose")
        time.sleep(0.8)  # twice what its queue of ten messages holds
        deadline = time.monotonic() + TIMEOUT
        while not right.told and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
            right.listen()
        assert right.told == ["linked to left: no pose"]
    finally:
        executor.shutdown()
        busy.destroy_node()
        context.try_shutdown()


def test_an_old_fault_pauses_nobody_who_came_later_or_was_engaged_since(make: Make) -> None:
    left = make("left")
    left.link.report("old")
    time.sleep(0.5)  # far more than what a message takes while two nodes are getting to know each other
    right = make("right")
    right.link.engaged()
    eventually(lambda: right.node.count_publishers("/robot/left/link") == 1, "they know each other")
    assert right.listen_for_a_while() == []
    left.link.report("new")
    eventually(right.hears("new"), "a new fault is told")
    assert right.told == ["linked to left: new"]


def test_both_at_fault_pause_once_each_and_are_engaged_one_by_one(pair: tuple[End, End]) -> None:
    left, right = pair
    for end in pair:
        end.link.engaged()
    left.link.report("left is lost")
    right.link.report("right is lost")
    eventually(left.hears("right is lost"), "left is told")
    eventually(right.hears("left is lost"), "right is told")
    left.link.engaged()  # while the right arm's fault stands
    assert left.listen_for_a_while() == ["linked to right: right is lost"]
    right.link.engaged()
    assert right.listen_for_a_while() == ["linked to left: left is lost"]
    right.link.report("right is lost again")
    eventually(left.hears("right is lost again"), "left is told of the next fault")
    assert len(right.listen()) == 1


def test_a_node_that_dies_is_named_and_its_return_pauses_nobody_until_its_next_fault(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
    eventually(right.hears("silent"), "its silence is told")
    (line,) = right.told
    assert line.startswith("linked to left: /left_arm is silent for 1.")
    right.link.engaged()  # alone
    again = make("left")
    eventually(lambda: right.node.count_publishers("/robot/left/link") == 1, "it is back")
    assert right.listen_for_a_while() == [line]
    again.link.report("first fault of its new life")
    eventually(right.hears("first fault of its new life"), "numbers begin anew with a node")


def test_a_node_started_anew_before_its_silence_is_noticed_pauses_the_other_arm(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
        make("left")
        eventually(right.hears("/left_arm was restarted without announcing its end, or runs twice"), "it is reported")


def test_a_node_that_ends_in_order_pauses_the_other_arm_once_and_is_not_missed(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
        node.destroy_timer(next(iter(node.timers)))  # the announced end is a node's last message
        left.link.close()
        eventually(right.hears("/left_arm has ended"), "the end is announced")
    time.sleep(TIMEOUT)
    assert right.listen_for_a_while() == ["linked to left: /left_arm has ended"]


def test_what_is_no_sign_of_life_is_passed_over(make: Make) -> None:
    from std_msgs.msg import String

    right = make("right")
    stranger = right.node.create_publisher(String, "/robot/left/link", 10)
    right.link.engaged()
    for text in ("alive", "{}", '{"node": "/x", "id": "1", "fault": -1}', '{"node": "/x", "id": "1", "age": null}'):
        stranger.publish(String(data=text))
    time.sleep(TIMEOUT)
    assert right.listen_for_a_while() == [], "a stranger's silence is no fault either"
