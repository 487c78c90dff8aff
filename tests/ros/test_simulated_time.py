"""Arms in simulated time: without it nothing engages, and where it stops an engaged arm is paused."""

from __future__ import annotations

import time
from typing import Any

from tests.ros.conftest import need_ros
from tests.ros.processes import Processes

need_ros()

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from rosgraph_msgs.msg import Clock

from q2r2_control.ros.bridge.messages import time_message
from tests.ros.arm_rig import ArmRig


def test_an_arm_without_time_cannot_be_engaged_and_one_whose_time_stops_is_paused(
    node: Any, processes: Processes
) -> None:
    diagnostics: list[DiagnosticStatus] = []
    node.create_subscription(DiagnosticArray, "/diagnostics", lambda message: diagnostics.extend(message.status), 10)
    rig = ArmRig(node)
    rig.start(processes, {"use_sim_time": True})
    rig.wait(lambda: rig.state["message"].startswith("use_sim_time is set and nothing comes"), "it says so")
    rig.wait(lambda: diagnostics and "nothing comes on /clock" in diagnostics[-1].message, "so do the diagnostics")
    assert (diagnostics[-1].name, diagnostics[-1].level) == ("/left_q2r2_arm_controller", DiagnosticStatus.ERROR)
    rig.press()
    assert (rig.state["engaged"], rig.state["ready"], rig.targets) == (False, False, [])

    publisher, began = node.create_publisher(Clock, "/clock", 1), time.monotonic()

    def send_time() -> None:
        publisher.publish(Clock(clock=time_message(1.0 + time.monotonic() - began)))

    timer = node.create_timer(0.01, send_time)
    rig.wait(lambda: rig.state["ready"], "it is ready when time comes")
    assert (rig.state["engaged"], rig.targets) == (False, [])  # by the press before
    rig.engage()
    node.destroy_timer(timer)
    # On a machine with other load something else may have paused it before, so the reason is asked of what it says now.
    rig.wait(lambda: "time on /clock stands still" in rig.state["message"], "it says that time stops")
    rig.wait(lambda: not rig.state["engaged"] and not rig.state["ready"], "it is paused")
    rig.press()
    node.create_timer(0.01, send_time)
    rig.wait(lambda: rig.state["ready"], "it is ready when time goes on")
    assert not rig.state["engaged"]
