"""The executor of nodes that tick, with real entities of rclpy: what is run, in which order, and what ends it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Mapping
from typing import Any

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE

need_ros()

from rclpy.callback_groups import ReentrantCallbackGroup
from rclpy.executors import ExternalShutdownException, SingleThreadedExecutor
from std_msgs.msg import String
from std_srvs.srv import Trigger

from q2r2_control.ros.base_node import LATCHED_QOS, BaseNode
from q2r2_control.ros.executor import TickExecutor

PERIOD = 0.01  # of the node's tick [s]


class Ticking(BaseNode):
    """A node that hears words."""

    ticks = True

    def __init__(self, context: Any) -> None:
        super().__init__("ticking", context=context)
        self.log: list[str] = []

    def listen(self, qos: Any = 10) -> Any:
        """A publisher whose words are logged."""
        publisher = self.create_publisher(String, "words", qos)
        self.create_subscription(String, "words", lambda message: self.log.append(message.data), qos)
        return publisher


@pytest.fixture
def ticking(context: Any) -> Iterator[Ticking]:
    node = Ticking(context)
    yield node
    node.destroy_node()


@pytest.fixture
def executor(ticking: Ticking, context: Any) -> Iterator[TickExecutor]:
    made = TickExecutor(context=context)
    made.add_node(ticking)
    yield made
    made.shutdown()


def spin_until(executor: Any, condition: Callable[[], object]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not condition():
        assert time.monotonic() < deadline
        executor.spin_once(timeout_sec=0.1)


def say(publisher: Any, executor: TickExecutor, *words: str) -> None:
    """Publish once all subscriptions are matched, and wait until the words have arrived."""
    spin_until(executor, publisher.get_subscription_count)
    for word in words:
        publisher.publish(String(data=word))
    time.sleep(0.1)


def test_all_that_has_arrived_is_taken_in_order_before_the_tick_with_its_times_if_asked_for(
    ticking: Ticking, executor: TickExecutor
) -> None:
    times: list[Mapping[str, int]] = []
    ticking.create_subscription(String, "words", lambda _, info: times.append(info), 10)
    say(ticking.listen(), executor, "one", "two", "three")
    ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    spin_until(executor, lambda: "tick" in ticking.log)
    assert ticking.log[:4] == ["one", "two", "three", "tick"]
    assert 0 < times[-1]["source_timestamp"] <= times[-1]["received_timestamp"]


def test_latched_messages_are_heard_too_and_a_cancelled_tick_is_silent(
    ticking: Ticking, executor: TickExecutor
) -> None:
    timer = ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    ticking.listen(LATCHED_QOS).publish(String(data="said before"))
    spin_until(executor, lambda: {"tick", "said before"} <= set(ticking.log))
    timer.cancel()
    ticking.log.clear()
    for _ in range(20):
        executor.spin_once(timeout_sec=PERIOD)
    assert ticking.log == []


def test_a_subscription_that_a_message_destroys_gets_none_that_had_come_before(
    ticking: Ticking, executor: TickExecutor
) -> None:
    subscriptions: list[Any] = []

    def hear(message: Any) -> None:
        ticking.log.append(message.data)
        while subscriptions:
            ticking.destroy_subscription(subscriptions.pop())

    publisher = ticking.create_publisher(String, "words", 10)
    subscriptions += [ticking.create_subscription(String, "words", hear, 10) for _ in range(2)]
    spin_until(executor, lambda: publisher.get_subscription_count() == 2)
    say(publisher, executor, "one", "two")
    for _ in range(3):
        executor.spin_once(timeout_sec=0.05)
    assert ticking.log == ["one"]


def test_services_are_answered_and_coroutines_run(ticking: Ticking, executor: TickExecutor) -> None:
    def serve(_: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success = True
        return response

    ticking.create_service(Trigger, "serve", serve, callback_group=ReentrantCallbackGroup())
    client = ticking.create_client(Trigger, "serve", callback_group=ReentrantCallbackGroup())

    async def ask() -> None:
        ticking.log.append("asks")
        timer.cancel()
        answer = await client.call_async(Trigger.Request())
        ticking.log.append(f"success: {answer.success}")

    spin_until(executor, client.service_is_ready)
    timer = ticking.create_timer(PERIOD, ask)
    spin_until(executor, lambda: len(ticking.log) == 2)
    assert ticking.log == ["asks", "success: True"]


@pytest.mark.parametrize("make", [BaseNode.create_tick, BaseNode.create_timer], ids=["a tick's", "a slow timer's"])
def test_an_error_of_a_callback_comes_out(make: Any, ticking: Ticking, executor: TickExecutor) -> None:
    def fail() -> None:
        raise ValueError("of the callback")

    make(ticking, PERIOD, fail)
    with pytest.raises(ValueError, match="of the callback"):
        spin_until(executor, lambda: False)


def test_it_ends_with_its_context(executor: TickExecutor, context: Any) -> None:
    executor.spin_once(timeout_sec=0.0)
    context.try_shutdown()
    with pytest.raises(ExternalShutdownException):
        spin_until(executor, lambda: False)


def test_another_executor_runs_ticks_and_messages_as_well(
    ticking: Ticking, executor: TickExecutor, context: Any
) -> None:
    say(ticking.listen(), executor, "one")
    executor.remove_node(ticking)
    plain = SingleThreadedExecutor(context=context)
    plain.add_node(ticking)
    ticking.create_tick(PERIOD, lambda: ticking.log.append("tick"))
    spin_until(plain, lambda: {"one", "tick"} <= set(ticking.log))
    plain.shutdown()
