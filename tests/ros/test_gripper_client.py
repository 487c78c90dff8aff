"""A gripper's client asks before it commands. The gripper moves only as far as is permitted, whatever fails."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing
from queue import Queue

import pytest

from q2r2_control.config.external import GripperSettings, GripperType
from tests.ros.conftest import need_ros, spun_node

need_ros()

from control_msgs.action import GripperCommand
from rclpy.action import ActionServer, GoalResponse
from std_msgs.msg import Float64MultiArray

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.bridge.gripper_client import GripperClient, OpeningGrants
from tests.ros.processes import wait_until

_CLOSED = 0.05  # [m]


class Bench:
    """A gripper's client, a gripper that reaches or refuses every goal, and grants that the test sends."""

    def __init__(self, domain: int, kind: GripperType = GripperType.GRIPPER_COMMAND, topic: str = "/gripper") -> None:
        self._nodes = ExitStack()
        self.close = self._nodes.close
        near, self.far = (self._nodes.enter_context(spun_node(domain, name)) for name in ("near", "far"))
        self.goals: Queue[float] = Queue()  # Commanded openings.
        self.asked: list[list[float]] = []  # Pairs of wanted and commanded openings.
        self.refuses = False
        self.answers = self.far.create_publisher(Float64MultiArray, "/controller/opening/left", LATCHED_QOS)
        self.far.create_subscription(
            Float64MultiArray,
            "/targets/wanted_opening",
            lambda message: self.asked.append(list(message.data)),
            LATCHED_QOS,
        )
        self.far.create_subscription(
            Float64MultiArray, "/fingers", lambda message: self.goals.put(1.0 - message.data[0] / _CLOSED), 10
        )
        self.server = ActionServer(self.far, GripperCommand, "/gripper", self._execute, goal_callback=self._check)
        self.grants = OpeningGrants(near, "/controller", "left", "/targets")
        settings = GripperSettings(action_type=kind, closed_position=_CLOSED)
        self.client = GripperClient(near, topic, settings, self.grants)
        wait_until(lambda: self.grants.answered and self.client._has_server(), "all know of each other")

    def _check(self, goal: GripperCommand.Goal) -> GoalResponse:
        return GoalResponse.REJECT if self.refuses else GoalResponse.ACCEPT

    def _execute(self, handle: object) -> GripperCommand.Result:
        position = handle.request.command.position  # type: ignore[attr-defined]
        self.goals.put(1.0 - position / _CLOSED)
        handle.succeed()  # type: ignore[attr-defined]
        return GripperCommand.Result(position=position, reached_goal=True)

    def grant(self, wanted: float, granted: float) -> None:
        self.answers.publish(Float64MultiArray(data=[wanted, granted]))

    def wait(self, condition: Callable[[], object], what: str) -> None:
        def ticked() -> object:
            self.client.check(time.monotonic())
            return condition()

        wait_until(ticked, what, lambda: (self.client.state, self.client.problem, list(self.goals.queue), self.asked))

    def pass_time(self, seconds: float) -> None:
        until = time.monotonic() + seconds
        self.wait(lambda: time.monotonic() > until, "time passes")

    def command(self, close: bool) -> None:
        self.client.command(close, time.monotonic())

    def openings(self) -> list[float]:
        return [round(opening, 6) for opening in list(self.goals.queue)]


@pytest.fixture
def bench(domain: int) -> Iterator[Bench]:
    with closing(Bench(domain)) as bench:
        yield bench


def test_a_gripper_opens_in_steps_as_is_permitted_and_counts_as_open_only_at_the_end(bench: Bench) -> None:
    bench.command(close=True)
    bench.pass_time(0.3)
    assert bench.openings() == []  # Nothing is permitted yet.
    bench.grant(0.0, 0.0)
    bench.wait(lambda: bench.client.closed, "it is closed")
    bench.command(close=False)
    bench.grant(1.0, 0.4)
    bench.wait(lambda: bench.openings() == [0.0, 0.4], "it opens a part of the way")
    bench.pass_time(0.5)
    assert bench.client.state == "opening"
    assert bench.client.closed
    bench.grant(1.0, 1.0)
    bench.wait(lambda: bench.client.state == "open", "it is open")
    assert bench.openings() == [0.0, 0.4, 1.0]
    wait_until(lambda: bench.asked and bench.asked[-1] == [1.0, 1.0], "it says what it was commanded to")


def test_a_request_without_an_answer_is_dropped_and_reported(bench: Bench) -> None:
    bench.grant(1.0, 1.0)  # The grant belongs to an earlier request.
    bench.command(close=True)
    bench.wait(lambda: bench.client.problem, "it gives up")
    assert bench.client.problem == "/gripper goes no farther: the controller that grants openings does not answer"
    bench.grant(0.0, 0.0)
    bench.pass_time(0.5)
    assert bench.openings() == []


def test_a_press_while_no_server_is_there_ends_the_previous_request(bench: Bench) -> None:
    bench.command(close=False)
    bench.grant(1.0, 0.4)
    bench.wait(lambda: bench.asked and bench.asked[-1] == [1.0, 0.4], "it opens a part of the way")
    # The server is destroyed in the executor's thread, because rclpy fails if an action server ends while its executor
    # is about to wait for it.
    bench.far.executor.create_task(bench.server.destroy)
    wait_until(lambda: not bench.client._has_server(), "the server is gone")
    bench.command(close=True)
    assert bench.client.problem == "no gripper server at /gripper"
    wait_until(lambda: bench.asked[-1] == [0.4, 0.4], "it wants to stay where it is")
    bench.grant(1.0, 1.0)
    bench.pass_time(0.5)
    assert bench.asked[-1] == [0.4, 0.4]


def test_a_gripper_follows_a_trigger_at_most_ten_times_a_second(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[float] = []
    monkeypatch.setattr(bench.grants, "ask", asked.append)
    for step in range(21):
        bench.client.move(1.0 - 0.04 * step, 0.01 * step)
    bench.client.move(0.0, 0.3)
    bench.client.move(0.005, 0.5)  # The change is too small to follow.
    assert asked == pytest.approx([0.96, 0.56, 0.0])


def test_a_goal_that_the_gripper_refuses_ends_the_request(bench: Bench) -> None:
    bench.command(close=True)
    bench.grant(0.0, 0.0)
    bench.wait(lambda: bench.client.closed, "it is closed")
    bench.refuses = True
    bench.command(close=False)
    bench.grant(1.0, 0.3)
    bench.wait(lambda: bench.client.problem, "the refusal is told")
    bench.refuses = False
    bench.grant(1.0, 1.0)
    bench.pass_time(0.5)
    assert bench.openings() == [0.0]
    assert bench.client.state == "closed"


def test_before_a_grant_a_gripper_with_a_command_topic_gets_no_command_and_counts_both_of_two_presses(
    domain: int,
) -> None:
    with closing(Bench(domain, GripperType.FLOAT64_MULTI_ARRAY, "/fingers")) as bench:
        bench.client.toggle(time.monotonic())
        bench.client.toggle(time.monotonic())
        bench.grant(1.0, 0.6)
        bench.wait(lambda: bench.openings() == [0.6], "it opens a part of the way")
        bench.grant(1.0, 1.0)
        bench.wait(lambda: bench.openings() == [0.6, 1.0], "and to the end")
        assert bench.client.state == "open"


def test_a_press_is_reported_as_failed_if_no_node_reads_the_grippers_topic(domain: int) -> None:
    with spun_node(domain, "alone") as node:
        settings = GripperSettings(action_type=GripperType.FLOAT64_MULTI_ARRAY, closed_position=_CLOSED)
        client = GripperClient(node, "/nobody", settings)
        client.command(True, 0.0)
        assert (client.problem, client.state) == ("no gripper server at /nobody", "open")
