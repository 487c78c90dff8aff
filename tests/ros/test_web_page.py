"""The page of a set of real nodes: its content, and the requests of its buttons."""

from __future__ import annotations

import json
import os
import signal
import sys
from functools import partial
from pathlib import Path
from typing import Any

import pytest

pytest.importorskip("viser", reason="the extra web brings it")

from tests.ros.arm_rig import PATIENT
from tests.ros.cell import changed_cell
from tests.ros.conftest import need_ros
from tests.ros.processes import CONFIG, Processes, RosProcess, States, wait_until
from tests.ros.test_processes import external_cell

need_ros()

from geometry_msgs.msg import Point, Pose, Vector3
from sensor_msgs.msg import CompressedImage
from std_msgs.msg import Header, String
from visualization_msgs.msg import Marker

from q2r2_control.recording.messages import arm_events
from q2r2_control.ros.base_node import RECORDED_QOS, STREAM_QOS
from tests.support.page_client import PageClient
from tests.support.processes import children

CAMERA = {"front": {"topic": "/front/compressed"}}
PATIENCE = 120.0  # Timeout for a whole set on a busy machine [s].
RATE = 60.0  # A quarter of the default, because six nodes share a busy machine. The page looks the same [Hz].
# The program does the same as `q2r2 ros up`, with parameters that tolerate other load.
SET = """
import json, sys
from dataclasses import replace
from q2r2_control.ros.launch.processes import nodes_of, run_together

cell, folder, changes = sys.argv[1], sys.argv[2], json.loads(sys.argv[3])
nodes = nodes_of(cell, recording={"folder": folder}, page=("127.0.0.1", 0))
nodes = [replace(node, parameters={**node.parameters, **changes.get(node.name, {})}) for node in nodes]
sys.exit(run_together(nodes, lambda line: print(line, flush=True)))
"""
CHANGES = {
    **{name: {"rate": RATE} for name in ("mujoco_robot", "recorder", "web_page")},
    "cartesian_controller": {"rate": RATE, "joint_state_timeout": 1.0, "target_timeout": 2.0, "listener_timeout": 3.0},
    "arm_controllers": {"rate": RATE, **PATIENT},
}
# If the robot's process gets little processor time, its arms are far behind their reference.
LENIENT = {"supervision": {"max_deviation": 0.5}}
CHANGES["mujoco_robot"]["max_jump"] = 1.0  # On a busy machine, commands may come late and several at a time.


def url_of(process: RosProcess) -> str:
    return process.wait_for("page: http", PATIENCE).rpartition(" ")[2]


@pytest.mark.alone
def test_the_page_of_a_set_shows_its_arms_and_its_buttons_reach_the_nodes(
    node: Any, processes: Processes, tmp_path: Path
) -> None:
    cell = changed_cell(
        tmp_path, cameras=CAMERA, control={"moving_obstacles": ["hand"], "tool_speed_limit": 0.25}, **LENIENT
    )
    up = processes.start(sys.executable, "-u", "-c", SET, cell, str(tmp_path), json.dumps(CHANGES), name="up")
    with PageClient(url_of(up)) as page:
        page.wait_until(lambda: page.row("state") == ["engaged", "engaged"])
        before = page.row("tool [m]")
        page.wait_until(lambda: page.row("tool [m]") != before)
        page.wait_until(lambda: "certified" in page.words and "mm" in page.row("off its target")[0])
        page.wait_until(lambda: page.row("tool speed [m/s]")[0].endswith(" of 0.25"))
        camera = node.create_publisher(CompressedImage, "/front/compressed", STREAM_QOS)
        picture = CompressedImage(data=b"a JPEG")
        page.wait_until(lambda: camera.publish(picture) or b"a JPEG" in page.pictures)

        hands = node.create_publisher(Marker, "/cartesian_controller/obstacles", 10)
        far = Pose(position=Point(x=0.6, y=2.5, z=0.4))
        hand = {"header": Header(frame_id="world"), "type": Marker.SPHERE, "scale": Vector3(x=0.2, y=0.2, z=0.2)}
        marker = Marker(ns="hand", text="speed: 0.1", pose=far, **hand)
        page.wait_until(lambda: hands.publish(marker) or "/obstacles/hand" in page.drawn)
        hands.publish(Marker(ns="hand", action=Marker.DELETE))
        page.press("Pause both")
        page.wait_until(lambda: all("the pause service" in why for why in page.row("why")))
        page.press("Bring both")
        page.wait_until(lambda: page.row("state") == ["homing", "homing"])
        page.press("Pause both")  # The pause also ends homing.
        page.wait_until(lambda: "homing" not in page.row("state"))
        page.press("Stop")
        page.wait_until(lambda: all("the stop service" in why for why in page.row("why")))
        page.press("Bring both")
        page.wait_until(lambda: "/cartesian_controller/home: " in page.words)  # Homing is refused with a reason.
        page.press("Take a stop back")
        page.wait_until(lambda: all("waits for its operator" in why for why in page.row("why")))
        assert "engaged" not in page.row("state")
        page.press("Engage both")  # The scripted hands do not press again, so the page engages the arms.
        page.wait_until(lambda: page.row("state") == ["engaged", "engaged"])

        for label, told in (("Begin or end", "episode begins"), ("Mark", "mark"), ("Begin or end", "episode ends")):
            page.press(label)
            page.wait_until(partial(page.says, f"|{told}|"))
    assert up.interrupt(PATIENCE) == 0


def test_neither_a_closed_page_nor_a_strange_message_ends_a_set(node: Any, processes: Processes) -> None:
    process = processes.start_node("web_page", f"config:={CONFIG}", "web_port:=0")
    url_of(process)
    publisher = node.create_publisher(String, arm_events("left"), RECORDED_QOS)
    wait_until(publisher.get_subscription_count, "the page listens to events")
    publisher.publish(String(data="{"))
    process.wait_for("cannot be read")
    (server,) = children(process.pid)
    os.kill(server, signal.SIGKILL)
    assert "the page is gone" in States(node, "web_page").wait_for(level="warn")["message"]
    assert process.interrupt(60.0) == 0


def test_a_cell_without_the_built_in_controller_has_no_page(processes: Processes, tmp_path: Path) -> None:
    process = processes.start_node("web_page", f"config:={external_cell(tmp_path, 'fzi', 'raw')}")
    assert process.wait(60.0) == 2
    assert "has no ticks to show; allowed: controller: builtin, or mode: filtered" in process.output
