"""The link between the arms' nodes, with real nodes and real messages, some of which are lost."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from typing import Any

import pytest

from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.waiting import wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)

from q2r2_control.ros.monitoring.arm_link import ArmLink
from q2r2_control.teleop.both_arms import PAUSE_FIRST

TIMEOUT = 1.0  # longer than by default, so that other load on the machine does not look like silence [s]
MEANWHILE = 0.3  # time for several heartbeats [s]


class End:
    """One arm's node with its end of the link, and the faults that it received."""

    def __init__(self, node: Any, arm: str) -> None:
        self.node = node
        self.link = ArmLink(node, "robot", arm, "side_by_side", TIMEOUT)
        self.faults: list[str] = []
        self.linked = True

    def listen(self) -> list[str]:
        if (fault := self.link.take_fault(self.linked)) is not None:
            self.faults.append(fault)
        return self.faults

    def hears(self, text: str) -> Callable[[], bool]:
        return lambda: any(text in line for line in self.listen())

    def listen_for_a_while(self) -> list[str]:
        """All faults received until several more heartbeats have come."""
        deadline = time.monotonic() + MEANWHILE
        while time.monotonic() < deadline:
            self.listen()
            time.sleep(0.01)
        return self.faults


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
    """Wait until each receives the other's heartbeat, by faults that are then forgotten."""
    for speaker, hearer in ((left, right), (right, left)):
        speaker.link.report("hello")
        wait_until(hearer.hears("hello"), "a fault is heard")
    for end in (left, right):
        end.listen_for_a_while()
        end.faults.clear()


def test_a_fault_pauses_the_other_arm_once_however_often_it_is_repeated(pair: tuple[End, End]) -> None:
    left, right = pair
    right.link.engaged()
    left.link.report("the hand jumped")
    wait_until(right.hears("the hand jumped"), "the fault is received")
    assert right.listen_for_a_while() == ["linked to left: the hand jumped"]
    right.link.engaged()
    assert right.listen_for_a_while() == ["linked to left: the hand jumped"]
    left.link.report("the hand jumped")
    wait_until(lambda: len(right.listen()) == 2, "the same fault once more is another fault")


def test_a_fault_whose_first_messages_are_lost_is_told_by_the_next_ones(make: Make) -> None:
    right = make("right")
    right.link.engaged()
    left = make("left")
    left.link.report("no pose")  # before anybody can have subscribed
    left.link.engaged()  # and its own arm is engaged again at once
    wait_until(right.hears("no pose"), "the fault is received")
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
        wait_until(lambda: left.node.count_subscribers("/robot/left/link") == 1, "it is subscribed")
        right.link.engaged()
        left.link.report("no pose")
        time.sleep(0.8)  # twice what its queue of ten messages holds
        deadline = time.monotonic() + TIMEOUT
        while not right.faults and time.monotonic() < deadline:
            executor.spin_once(timeout_sec=0.1)
            right.listen()
        assert right.faults == ["linked to left: no pose"]
    finally:
        executor.shutdown()
        busy.destroy_node()
        context.try_shutdown()


def test_an_alignment_pauses_the_other_arm_even_where_they_are_not_linked_and_nothing_else_does(
    pair: tuple[End, End],
) -> None:
    left, right = pair
    right.linked = False
    right.link.engaged()
    left.link.report("the hand jumped")
    assert right.listen_for_a_while() == []
    left.link.set_aligning(True)
    wait_until(right.hears("alignment chord"), "the alignment is heard")
    assert right.link.aligning == "the left arm's hand aligns the frame"
    assert right.listen_for_a_while() == ["linked to left: alignment chord"]
    left.link.set_aligning(False)
    wait_until(lambda: right.link.aligning is None, "its end is heard")
    assert right.listen_for_a_while() == ["linked to left: alignment chord"]


def test_an_old_fault_pauses_no_arm_that_started_later_or_was_engaged_since(make: Make) -> None:
    left = make("left")
    left.link.report("old")
    time.sleep(0.5)  # far more than what a message takes while two nodes are getting to know each other
    right = make("right")
    right.link.engaged()
    wait_until(lambda: right.node.count_publishers("/robot/left/link") == 1, "they know each other")
    assert right.listen_for_a_while() == []
    left.link.report("new")
    wait_until(right.hears("new"), "a new fault is received")
    assert right.faults == ["linked to left: new"]


def test_both_at_fault_pause_once_each_and_are_engaged_one_by_one(pair: tuple[End, End]) -> None:
    left, right = pair
    for end in pair:
        end.link.engaged()
    left.link.report("left is lost")
    right.link.report("right is lost")
    wait_until(left.hears("right is lost"), "left receives it")
    wait_until(right.hears("left is lost"), "right receives it")
    left.link.engaged()  # while the right arm's fault stands
    assert left.listen_for_a_while() == ["linked to right: right is lost"]
    right.link.engaged()
    assert right.listen_for_a_while() == ["linked to left: left is lost"]
    right.link.report("right is lost again")
    wait_until(left.hears("right is lost again"), "left receives the next fault")
    assert len(right.listen()) == 1


def test_a_node_that_dies_is_named_and_its_restart_pauses_no_arm_until_its_next_fault(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
    wait_until(right.hears("silent"), "its silence is reported")
    (line,) = right.faults
    assert line.startswith("linked to left: /left_arm is silent for 1.")
    right.link.engaged()  # alone
    again = make("left")
    wait_until(lambda: right.node.count_publishers("/robot/left/link") == 1, "it is back")
    assert right.listen_for_a_while() == [line]
    again.link.report("first fault after the restart")
    wait_until(right.hears("first fault after the restart"), "numbers begin anew with a node")


def test_a_node_restarted_before_its_silence_is_noticed_pauses_the_other_arm(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
        make("left")
        wait_until(right.hears("/left_arm was restarted without announcing its end, or runs twice"), "it is reported")


def test_a_node_that_ends_in_order_pauses_the_other_arm_once(make: Make, domain: int) -> None:
    right = make("right")
    with spun_node(domain, "left_arm") as node:
        left = End(node, "left")
        meet(left, right)
        right.link.engaged()
        node.destroy_timer(next(iter(node.timers)))  # the announced end is a node's last message
        left.link.close()
        wait_until(right.hears("/left_arm has ended"), "the end is announced")
    time.sleep(TIMEOUT)
    assert right.listen_for_a_while() == ["linked to left: /left_arm has ended"]


def test_hands_that_one_arm_has_swapped_are_swapped_for_both(pair: tuple[End, End]) -> None:
    left, right = (end.link for end in pair)
    wait_until(lambda: left.unswappable == PAUSE_FIRST, "the other arm is not at rest")
    left.at_rest = right.at_rest = True
    wait_until(lambda: left.unswappable is None and right.unswappable is None, "both are at rest")
    for link, other, swapped in ((left, right, True), (right, left, False)):
        link.set_swapped(swapped)
        wait_until(lambda o=other, s=swapped: o.swapped is s, "the other node does so")  # type: ignore[misc]
        wait_until(lambda o=link: o.swapping is None, "and says so")  # type: ignore[misc]


def test_a_node_that_has_not_swapped_hands_yet_is_named(make: Make, domain: int) -> None:
    from std_msgs.msg import String

    link = make("left").link
    assert link.unswappable == "the right arm's node is not there"
    with spun_node(domain, "other") as node:
        publisher = node.create_publisher(String, "/robot/right/link", 10)
        node.create_timer(0.02, lambda: publisher.publish(String(data='{"node": "/it", "id": "1", "at_rest": true}')))
        wait_until(lambda: link.unswappable is None, "its heartbeat comes")
        link.set_swapped(True)
        assert link.swapping == "/it has not swapped hands yet"
        assert link.unswappable == link.swapping


def test_messages_that_are_no_heartbeats_are_ignored(make: Make) -> None:
    from std_msgs.msg import String

    right = make("right")
    sender = right.node.create_publisher(String, "/robot/left/link", 10)
    right.link.engaged()
    for text in ("alive", "{}", '{"node": "/x", "id": "1", "fault": -1}', '{"node": "/x", "id": "1", "age": null}'):
        sender.publish(String(data=text))
    time.sleep(TIMEOUT)
    assert right.listen_for_a_while() == [], "its silence is no fault either"
