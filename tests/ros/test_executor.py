"""The executor of nodes that tick, with real entities of rclpy: what is run, in which order, and what ends it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import PATIENCE

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("control_msgs", reason="needs control_msgs: q2r2 ros build-interfaces")

from control_msgs.action import GripperCommand
from rclpy.action import ActionClient
from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.executors import ExternalShutdownException
from rclpy.node import Node
from std_msgs.msg import String
from std_srvs.srv import Trigger

from q2r2_control.ros.bridge.grippers import GripperServer, Stroke
from q2r2_control.ros.executor import TickExecutor

PERIOD = 0.01  # of the node's timer [s]


@pytest.fixture
def ticking(context: Any) -> Iterator[Node]:
    node = Node("ticking", context=context)
    yield node
    node.destroy_node()


@pytest.fixture
def executor(ticking: Node, context: Any) -> Iterator[TickExecutor]:
    made = TickExecutor(context=context)
    made.add_node(ticking)
    yield made
    made.shutdown()


def spin_until(executor: TickExecutor, condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.1)


def listen(node: Node, heard: list[str], topic: str = "words") -> Any:
    """A publisher whose messages are ``heard``."""
    publisher = node.create_publisher(String, topic, 10)

    def hear(message: Any) -> None:
        heard.append(message.data)

    node.create_subscription(String, topic, hear, 10)
    return publisher


def test_all_that_has_arrived_is_taken_in_order_before_the_tick(ticking: Node, executor: TickExecutor) -> None:
    log: list[str] = []
    publisher = listen(ticking, log)
    spin_until(executor, publisher.get_subscription_count)
    for word in ("one", "two", "three"):
        publisher.publish(String(data=word))
    time.sleep(0.1)
    ticking.create_timer(PERIOD, lambda: log.append("tick"))
    spin_until(executor, lambda: "tick" in log)
    assert log[:4] == ["one", "two", "three", "tick"]


def test_timers_keep_their_period(ticking: Node, executor: TickExecutor) -> None:
    ticks: list[float] = []
    steady = Clock(clock_type=ClockType.STEADY_TIME)
    ticking.create_timer(PERIOD, lambda: ticks.append(time.monotonic()), clock=steady)
    spin_until(executor, lambda: len(ticks) == 50)
    # A stall of the machine leaves ticks out; none comes early.
    assert ticks[-1] - ticks[0] > 48.0 * PERIOD


def test_timers_of_one_rate_that_are_due_together_run_after_one_wait(ticking: Node, executor: TickExecutor) -> None:
    log: list[str] = []
    timers = [ticking.create_timer(10.0 * PERIOD, partial(log.append, name)) for name in ("first", "second")]
    executor.spin_once(timeout_sec=0.0)
    for timer in timers:
        timer.reset()
    left = [timer.handle.time_until_next_call() for timer in timers]
    assert 0 <= left[1] - left[0] < 100_000, "microseconds lie between them"
    while not log:
        executor.spin_once(timeout_sec=1.0)
    assert log == ["first", "second"]


def test_a_cancelled_timer_and_a_destroyed_subscription_are_silent(ticking: Node, executor: TickExecutor) -> None:
    log: list[str] = []
    publisher = listen(ticking, log)
    timer = ticking.create_timer(PERIOD, lambda: log.append("tick"))
    spin_until(executor, lambda: "tick" in log)
    timer.cancel()
    ticking.destroy_subscription(next(one for one in ticking.subscriptions if one.topic_name.endswith("words")))
    log.clear()
    publisher.publish(String(data="word"))
    for _ in range(20):
        executor.spin_once(timeout_sec=PERIOD)
    assert log == []


def test_what_is_made_in_a_callback_runs_too(ticking: Node, executor: TickExecutor) -> None:
    log: list[str] = []
    publishers: list[Any] = []

    def make() -> None:
        if not publishers:
            publishers.append(listen(ticking, log, "later"))
        publishers[0].publish(String(data="word"))

    ticking.create_timer(PERIOD, make)
    spin_until(executor, lambda: log)


def test_services_are_answered_and_coroutines_run(ticking: Node, executor: TickExecutor) -> None:
    log: list[str] = []

    def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response

    ticking.create_service(Trigger, "serve", serve, callback_group=ReentrantCallbackGroup())
    client = ticking.create_client(Trigger, "serve", callback_group=ReentrantCallbackGroup())

    async def ask() -> None:
        log.append("asks")
        timer.cancel()
        answer = await client.call_async(Trigger.Request())
        log.append(f"success: {answer.success}")

    spin_until(executor, client.service_is_ready)
    timer = ticking.create_timer(PERIOD, ask)
    spin_until(executor, lambda: len(log) == 2)
    assert log == ["asks", "success: True"]


def test_a_goal_that_ends_at_a_tick_has_its_result_sent(ticking: Node, executor: TickExecutor) -> None:
    opening = 1.0

    def tick() -> None:
        nonlocal opening
        opening = max(opening - 0.02, 0.0)
        server.update(time.monotonic(), opening, effort=1.0)

    server = GripperServer(ticking, "gripper", Stroke(0.0, 0.05), lambda _: None, lambda _: None)
    client = ActionClient(ticking, GripperCommand, "gripper")
    ticking.create_timer(PERIOD, tick)
    spin_until(executor, client.server_is_ready)
    goal = GripperCommand.Goal()
    goal.command.position = 0.05
    sent = client.send_goal_async(goal)
    spin_until(executor, sent.done)
    result = sent.result().get_result_async()
    spin_until(executor, result.done)
    assert result.result().result.reached_goal
    client.destroy()


def test_an_error_of_a_callback_comes_out(ticking: Node, executor: TickExecutor) -> None:
    def fail() -> None:
        raise ValueError("of the callback")

    ticking.create_timer(PERIOD, fail)
    with pytest.raises(ValueError, match="of the callback"):
        spin_until(executor, lambda: False)


def test_it_ends_with_its_context(executor: TickExecutor, context: Any) -> None:
    executor.spin_once(timeout_sec=0.0)
    context.try_shutdown()
    with pytest.raises(ExternalShutdownException):
        spin_until(executor, lambda: False)


def test_a_topic_without_a_publisher_is_looked_at_less_often_and_its_first_message_is_heard(
    ticking: Node, executor: TickExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr("q2r2_control.ros.executor.time", SimpleNamespace(monotonic=lambda: now, sleep=time.sleep))
    heard: list[str] = []

    def hear(message: Any) -> None:
        heard.append(message.data)

    subscription = ticking.create_subscription(String, "later", hear, 10)
    ticking.create_timer(0.0, lambda: None)  # each spin is a tick
    executor.spin_once(timeout_sec=0.0)
    assert [one.entity for one in executor._quiet] == [subscription]
    publisher = ticking.create_publisher(String, "later", 10)
    executor._outdated = False  # as if another node had made it
    while not publisher.get_subscription_count():
        time.sleep(0.01)
    publisher.publish(String(data="first"))
    time.sleep(0.1)
    executor.spin_once(timeout_sec=0.0)
    assert heard == []
    now += 0.03

    def heard_when_looked_at_again() -> bool:
        nonlocal now
        now += 0.03
        return heard == ["first"]

    spin_until(executor, heard_when_looked_at_again)
    publisher.publish(String(data="second"))
    spin_until(executor, lambda: heard == ["first", "second"])  # at the same time by that clock


def test_a_topic_whose_publisher_has_said_nothing_yet_is_looked_at_in_each_tick(
    ticking: Node, executor: TickExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr("q2r2_control.ros.executor.time", SimpleNamespace(monotonic=lambda: now, sleep=time.sleep))
    heard: list[str] = []

    def hear(message: Any) -> None:
        heard.append(message.data)

    subscription = ticking.create_subscription(String, "later", hear, 10)
    ticking.create_timer(0.0, lambda: None)
    executor.spin_once(timeout_sec=0.0)
    publisher = ticking.create_publisher(String, "later", 10)
    executor._outdated = False
    while not (publisher.get_subscription_count() and subscription.get_publisher_count()):
        time.sleep(0.01)
    now += 1.0
    executor.spin_once(timeout_sec=0.0)
    publisher.publish(String(data="first"))
    spin_until(executor, lambda: heard == ["first"])  # at the same time by that clock


def test_a_subscription_that_a_message_destroys_gets_none_that_had_come_before(
    ticking: Node, executor: TickExecutor
) -> None:
    heard: list[str] = []
    subscriptions: list[Any] = []

    def hear(message: Any) -> None:
        heard.append(message.data)
        for subscription in subscriptions:
            ticking.destroy_subscription(subscription)
        subscriptions.clear()

    subscriptions += [ticking.create_subscription(String, "words", hear, 10) for _ in range(2)]
    publisher = ticking.create_publisher(String, "words", 10)
    spin_until(executor, lambda: publisher.get_subscription_count() == 2)
    for word in ("one", "two"):
        publisher.publish(String(data=word))
    time.sleep(0.1)
    for _ in range(3):
        executor.spin_once(timeout_sec=0.05)
    assert heard == ["one"]


def test_the_time_without_sleep_begins_anew_whenever_no_timer_is_due(
    ticking: Node, executor: TickExecutor, monkeypatch: pytest.MonkeyPatch
) -> None:
    now = 100.0
    monkeypatch.setattr("q2r2_control.ros.executor.time", SimpleNamespace(monotonic=lambda: now, sleep=lambda _: None))
    late = ticking.create_timer(0.0, lambda: None)  # always due
    ticking.create_timer(10.0, lambda: None)
    executor._slept = now
    for _ in range(3):
        now += 0.2
        executor.spin_once(timeout_sec=0.01)
    assert executor.awake == pytest.approx(0.6)
    late.cancel()
    executor.spin_once(timeout_sec=0.01)
    assert executor.awake == 0.0
