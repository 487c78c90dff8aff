"""What all nodes tell of themselves, whatever the time does."""

from __future__ import annotations

import os
import sys
from typing import Any

import pytest

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes
from tests.ros.waiting import States

need_ros()


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
