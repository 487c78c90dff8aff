"""Arms in simulated time: without it nothing engages, and where it stops an engaged arm is paused."""

from __future__ import annotations

import time
from typing import Any

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()

from tests.ros.arm_rig import ArmRig


def test_an_arm_without_time_cannot_be_engaged_and_one_whose_time_stops_is_paused(
    node: Any, processes: Processes
) -> None:
    from builtin_interfaces.msg import Time
    from rosgraph_msgs.msg import Clock

    rig = ArmRig(node)
    rig.start(processes, {"use_sim_time": True})
    rig.wait(lambda: rig.state["message"].startswith("use_sim_time is set and nothing comes"), "it says so")
    for _ in range(3):
        rig.press()
    assert (rig.state["engaged"], rig.state["ready"], rig.targets) == (False, False, [])

    publisher, began = node.create_publisher(Clock, "/clock", 1), time.monotonic()

    def tick() -> None:
        elapsed = time.monotonic() - began
        publisher.publish(Clock(clock=Time(sec=1 + int(elapsed), nanosec=int(elapsed % 1.0 * 1e9))))

    timer = node.create_timer(0.01, tick)
    rig.wait(lambda: rig.state["ready"], "it is ready when time comes")
    rig.engage()
    node.destroy_timer(timer)
    # On a machine with other load something else may have paused it before, so the reason is asked of what it says now.
    rig.wait(lambda: "time on /clock stands still" in rig.state["message"], "it says that time stops")
    rig.wait(lambda: not rig.state["engaged"] and not rig.state["ready"], "it is paused")
