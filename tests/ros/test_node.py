"""What all nodes tell of themselves, whatever the time does."""

from __future__ import annotations

import os
import sys
import time
from typing import Any

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.ros.waiting import States, wait_until

need_ros()


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


def test_all_threads_of_a_node_that_ticks_have_its_real_time_priority_where_it_is_permitted(
    node: Any, processes: Processes
) -> None:
    wanted = 7
    if sys.platform != "linux":
        pytest.skip("only Linux has SCHED_FIFO")
    states = States(node, "simulation_input")
    process = processes.start_node("SimulationInput", f"realtime_priority:={wanted}")
    states.wait_for("waits for a subscriber")
    refused = "no SCHED_FIFO" in process.output
    expected = (0, 0) if refused else (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, wanted)
    # The thread that ticks, and those of the middleware that were there before: others may have begun since.
    threads = [int(name) for name in os.listdir(f"/proc/{process.pid}/task")]
    found = [(os.sched_getscheduler(thread), os.sched_getparam(thread).sched_priority) for thread in sorted(threads)]
    assert found[0] == expected
    assert found.count(expected) > 1
