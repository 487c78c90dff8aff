"""What all nodes tell of themselves, whatever the time does."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import pytest

from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import Processes
from tests.ros.waiting import States, wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytestmark = pytest.mark.usefixtures("interfaces")


def test_a_node_in_simulated_time_says_that_no_clock_comes_until_one_does_and_when_it_stops(
    node: Any, processes: Processes
) -> None:
    from builtin_interfaces.msg import Time
    from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
    from rosgraph_msgs.msg import Clock

    diagnostics: list[Any] = []
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: diagnostics.extend(message.status), 10)
    states = States(node, "simulation_input")
    processes.start_node("SimulationInput", "use_sim_time:=true", "side:=left")
    state = states.wait_for("use_sim_time is set and nothing comes on /clock; waits for a subscriber of the left hand")
    assert state["level"] == "warn"
    wait_until(lambda: any("nothing comes on /clock" in status.message for status in diagnostics), "it is diagnosed")
    assert {(status.name, status.level) for status in diagnostics} == {("/simulation_input", DiagnosticStatus.WARN)}

    publisher = node.create_publisher(Clock, "/clock", 1)
    start = time.monotonic()

    def tick() -> None:
        elapsed = time.monotonic() - start
        publisher.publish(Clock(clock=Time(sec=1 + int(elapsed), nanosec=int(elapsed % 1.0 * 1e9))))

    timer = node.create_timer(0.02, tick)
    wait_until(lambda: diagnostics and "clock" not in diagnostics[-1].message, "the warning goes when the clock comes")
    node.destroy_timer(timer)
    states.wait_for("use_sim_time is set and the time on /clock stands still")


@pytest.mark.parametrize("wanted", [0, 7], ids=["none is wanted", "one is wanted"])
def test_all_threads_of_a_node_that_ticks_have_its_real_time_priority_where_it_is_permitted(
    wanted: int, node: Any, processes: Processes
) -> None:
    if sys.platform != "linux":
        pytest.skip("only Linux has SCHED_FIFO")
    states = States(node, "simulation_input")
    process = processes.start_node("SimulationInput", f"realtime_priority:={wanted}")
    states.wait_for("waits for a subscriber")
    refused = "no SCHED_FIFO" in process.output
    expected = (0, 0) if refused or not wanted else (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, wanted)
    assert not (refused and not wanted)
    # The thread that ticks, and those of the middleware that were there before: others may have begun since.
    threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
    found = [(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in sorted(threads)]
    assert found[0] == expected
    assert found.count(expected) > 1


BUSY = """
import sys, time
from q2r2_control.ros.base_node import BaseNode, run_nodes

class Busy(BaseNode):
    ticks, priority = True, 7

    def __init__(self):
        super().__init__("busy")
        self.begin = time.monotonic()
        self.create_tick(0.001, self.tick)

    def tick(self):  # which takes twice as long as its period
        end = time.monotonic() + 0.002
        while time.monotonic() < end:
            pass
        self.exit_code = 0 if time.monotonic() > self.begin + 2.0 else None

    def health(self):
        return b"\\0", "", {}

sys.exit(run_nodes([Busy]))
"""


def test_a_node_whose_ticks_leave_no_time_to_sleep_gives_up_its_priority(processes: Processes) -> None:
    process = processes.start(sys.executable, "-c", BUSY, name="busy")
    assert process.wait() == 0
    said = "given up, since ticks have left no time to sleep for 0.5 s", "no SCHED_FIFO"
    assert any(line in process.output for line in said)
