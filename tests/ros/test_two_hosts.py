"""Teleoperation on one host, controller and robot on the other: they meet, and a pulled cable stops the arms."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import pytest

from q2r2_control import Robot
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from tests.ros.conftest import NEEDS_ROS
from tests.ros.processes import CONFIG, Processes, RosProcess
from tests.ros.two_hosts import NotPermittedError, TwoHosts
from tests.ros.waiting import wait_until

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from q2r2_control.ros.launch.middleware import set_up_middleware  # noqa: E402
from tests.ros.joint_recorder import JointRecorder  # noqa: E402

ARMS = ("left_q2r2_arm_controller", "right_q2r2_arm_controller")
RATE = 100.0  # of the nodes, fewer than usual for a machine that plays two [Hz]
# Discovery reaches the other host as it does on a real network, and no shared memory bypasses the cable.
NETWORK = {"ROS_AUTOMATIC_DISCOVERY_RANGE": "SUBNET"}
set_up_middleware(NETWORK)
BRAKING = 5.44  # lowest acceleration limit of a joint of the cell [rad/s^2]
DELIVERY = 0.15  # allowance for messages and for a paused arm, which brakes at 2 m/s^2 of its tool [s]
STILL, FAST = 0.005, 1.7  # [rad], [rad/s]; see test_faults


class Hosts:
    """The nodes on both hosts, and observers that print what they hear there."""

    def __init__(self, network: TwoHosts, processes: Processes, robot: Robot) -> None:
        self.joints = JointRecorder(robot)
        self.robot = robot
        self.states: dict[str, tuple[float, dict[str, Any]]] = {}
        self._network, self._processes = network, processes
        for name in ("mujoco_robot", "cartesian_controller"):
            self.start("robot", f"q2r2_control.ros.nodes.{name}", f"rate:={RATE}", f"config:={CONFIG}")
        for name in ("left_arm_controller", "right_arm_controller"):
            self.start("operator", f"q2r2_control.ros.nodes.{name}", f"rate:={RATE}")
        self._observe("robot", "cartesian_controller")
        self._observe("operator", *ARMS)

    def start(self, host: str, module: str, *parameters: str) -> RosProcess:
        arguments = [part for parameter in parameters for part in ("-p", parameter)]
        return self._run(host, module, *(["--ros-args", *arguments] if arguments else []))

    def says(self, name: str, since: float, **values: Any) -> bool:
        """Whether a node's newest state is later than ``since`` [s] and has these values."""
        t, state = self.states.get(name, (0.0, {}))
        return t > since and all(state.get(key) == value for key, value in values.items())

    def wait_until_arms(self, **values: Any) -> None:
        now = time.monotonic()
        try:
            wait_until(lambda: all(self.says(arm, now, **values) for arm in ARMS), f"both arms are {values}")
        except AssertionError as error:
            raise AssertionError(f"{error}: {self.states}") from None

    def play(self) -> RosProcess:
        """Start the script, which presses until both arms follow, and wait until they move."""
        arms = [arm.joints for arm in self.robot.arms.values()]
        script = self.start("operator", "q2r2_control.ros.nodes.simulation_input")
        wait_until(
            lambda: all(self.joints.speeds(0.05)[joints].max() > 0.15 for joints in arms),
            "both arms follow the script",
            lambda: self.states,
        )
        return script

    def _run(self, host: str, module: str, *arguments: str) -> RosProcess:
        command = self._network.on(host, sys.executable, "-u", "-m", module, *arguments)
        return self._processes.start(*command, name=module.split(".")[-1], **NETWORK)

    def _observe(self, host: str, *nodes: str) -> None:
        process = self._run(host, "tests.ros.programs.observe", *nodes)
        threading.Thread(target=self._read, args=(process, host), daemon=True).start()

    def _read(self, process: RosProcess, host: str) -> None:
        with process.log.open() as lines:
            part = ""
            while process.running:
                part += lines.readline()
                if not part.endswith("\n"):
                    time.sleep(0.002)
                    continue
                if part.startswith("{"):
                    self._take(json.loads(part), host)
                part = ""

    def _take(self, said: dict[str, Any], host: str) -> None:
        if said["kind"] != "joints":
            self.states[said["kind"]] = said["t"], said["value"]
        elif host == "robot":
            names, q, v, stamp = said["value"]
            self.joints.take(names, q, v, said["t"], stamp)


@pytest.fixture
def network() -> Iterator[TwoHosts]:
    try:
        with TwoHosts() as made:
            yield made
    except NotPermittedError as error:
        pytest.skip(f"needs network namespaces: {error}")


def test_arms_follow_across_hosts_stop_when_the_cable_is_pulled_and_wait_for_a_press(
    domain: int, robot: Robot, network: TwoHosts, processes: Processes, record_property: Any
) -> None:
    hosts = Hosts(network, processes, robot)
    wait_until(lambda: hosts.joints.states, "joint states come")
    hosts.wait_until_arms(state="idle")
    script = hosts.play()
    time.sleep(0.5)

    pulled = time.monotonic()
    network.pull_cable()
    stop = hosts.joints.stop_after(pulled)
    allowed = STREAM_TIMEOUT + stop.fastest / BRAKING + DELIVERY + 2.0 * stop.starved
    line = (
        f"from {stop.speed:.2f} rad/s, {stop.fastest:.2f} at most, slow within {1e3 * stop.slow:.0f} ms, "
        f"allowed {1e3 * allowed:.0f}, of which for a starved machine {2e3 * stop.starved:.0f}"
    )
    record_property("cable pulled", line)
    print(f"\ncable pulled: {line}")
    assert stop.speed > 0.1
    assert stop.slow <= allowed
    hosts.wait_until_arms(state="lost", level="warn")

    network.plug_cable()
    hosts.wait_until_arms(state="lost", level="ok")
    time.sleep(1.0)
    assert hosts.joints.farthest_from(stop.posture, stop.t) < STILL, "the script went on and no arm followed it"
    script.end()
    began = time.monotonic()
    hosts.play()
    assert hosts.joints.fastest(began) < FAST
