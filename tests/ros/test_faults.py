"""Every node of a running set is killed or frozen while both arms move: they stop, and nothing but a press moves them.

Times are those of joint states received here, on the machine's steady clock.
"""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from functools import partial

import numpy as np
import pytest

from q2r2_control import Robot, load_config
from q2r2_control.config.timeouts import STREAM_TIMEOUT
from tests.ros.cell import CONFIG
from tests.ros.conftest import NEEDS_ROS, spun_node
from tests.ros.processes import PATIENCE, Processes
from tests.ros.waiting import eventually

pytest.importorskip("rclpy", reason=NEEDS_ROS)
pytest.importorskip("quest2ros", reason="needs q2r2 ros build-interfaces")
pytestmark = [pytest.mark.usefixtures("interfaces"), pytest.mark.alone]

from tests.ros.headset_operator import Operator  # noqa: E402
from tests.ros.joint_log import LONGEST_STARVED, Stop  # noqa: E402
from tests.ros.teleop_cell import ARMS, TeleopCell, address_of  # noqa: E402

BRAKING = 10.0  # acceleration_limit of the cell [rad/s^2]
# Allowance for messages, for processes to get their turn, and for an arm that is paused while its controller lives: it
# comes to rest at its last target, at 2 m/s^2 of the tool and not at the limits of the joints [s].
DELIVERY = 0.15
STILL = 0.005  # a joint that stands moves no farther [rad]
ANCHORED = 0.005  # a tool whose hand rests moves no farther [m]
FAST = 1.5  # no joint is faster when hands move at 0.3 m/s [rad/s]
AWHILE = 0.5  # in which something would have moved if anything did [s]

NODES = ("mujoco_robot", "cartesian_controller", "left_arm_controller", "right_arm_controller", "tcp_endpoint")
# The node that is killed, and what /diagnostics say then.
KILLED = {
    "tcp_endpoint": "of the left hand from /tcp_endpoint for 0.",
    "left_arm_controller": "linked to left: /left_q2r2_arm_controller is silent for 0.",
    "right_arm_controller": "linked to right: /right_q2r2_arm_controller is silent for 0.",
    "cartesian_controller": "/cartesian_controller",  # is silent, or acknowledges no targets
}
# The node that is frozen for a while, and what it says itself when it goes on.
FROZEN = {
    "left_arm_controller": "this node stood still for 1.",
    "cartesian_controller": "the control loop stood still for 1.",
}

Record = Callable[[str, object], None]


class Scene:
    """The set of nodes and its operator."""

    def __init__(self, cell: TeleopCell, operator: Operator, port: int) -> None:
        self.cell, self.operator, self._port = cell, operator, port

    def mend(self, name: str) -> None:
        """Start what was killed, wake what was frozen."""
        self.cell.mend(name, *([f"port:={self._port}"] if name == "tcp_endpoint" else []))

    def press(self) -> None:
        """Engage both arms, each by its own hand; again, where a busy machine has looked like a fault."""
        self.cell.wait_until_ready()
        deadline = time.monotonic() + PATIENCE
        while paused := [arm for arm in ARMS if not self.cell.engaged(arm)]:
            assert time.monotonic() < deadline, f"{paused} cannot be engaged: {self.cell.diagnoses[-5:]}"
            self.operator.press(*paused)
            time.sleep(0.1)

    def move(self) -> None:
        """Let both arms follow their hands at 0.3 m/s."""
        deadline = time.monotonic() + PATIENCE
        since: float | None = None
        while since is None or time.monotonic() - since < 0.3:
            assert time.monotonic() < deadline, f"the arms do not follow: {self.cell.diagnoses[-5:]}"
            if not all(map(self.cell.engaged, ARMS)):
                self.press()
            self.operator.moves = True
            since = (since or time.monotonic()) if self.cell.moving else None
            time.sleep(0.01)

    def move_again(self, name: str) -> None:
        """Mend a node, and let both arms follow anew."""
        self.mend(name)
        self.operator.rest()
        self.move()

    def play(self) -> None:
        """Start the script, and with it press, until both arms follow: a busy machine may look like a fault."""
        for _ in range(3):
            self.cell.start("simulation_input")
            deadline = time.monotonic() + PATIENCE / 3.0
            while time.monotonic() < deadline:
                if self.cell.moving:
                    time.sleep(0.3)  # it gathers speed
                    return
                time.sleep(0.01)
            self.cell.kill("simulation_input")
        raise AssertionError(f"the arms do not follow the script: {self.cell.diagnoses[-5:]}")

    def measure_stop(self, what: str, hurt: Callable[[], float], again: Callable[[], None], record: Record) -> Stop:
        """How both arms come to rest after a fault, which may take them no longer than it has to.

        ``hurt`` does it and says when. Where the robot or this test stood still meanwhile, which says nothing of the
        nodes, both arms move ``again`` and it is done once more.
        """
        stop = self.cell.joints.stop_after(hurt())
        for _ in range(2):
            if stop.starved <= LONGEST_STARVED:
                break
            print(f"\n{what}: no joint state came for {stop.starved:.2f} s; once more")
            again()
            stop = self.cell.joints.stop_after(hurt())
        # A machine that has no time for the robot or for this test has none for the node that has to act either.
        assert stop.starved <= LONGEST_STARVED, "the robot or this test stood still"
        allowed = STREAM_TIMEOUT + stop.speed / BRAKING + DELIVERY + 2.0 * stop.starved
        line = (
            f"from {stop.speed:.2f} rad/s slow within {1e3 * stop.slow:.0f} ms, allowed {1e3 * allowed:.0f}, "
            f"at rest within {1e3 * stop.rest:.0f} ms, allowed {1e3 * (allowed + STREAM_TIMEOUT):.0f}; "
            f"of which for a starved machine {2e3 * stop.starved:.0f}"
        )
        record(what, line)
        print(f"\n{what}: {line}")
        assert stop.speed > 0.1
        assert stop.slow <= allowed
        assert stop.rest <= allowed + STREAM_TIMEOUT  # of the targets, which end when the hand's data have been missed
        return stop

    def assert_only_a_press_moves(self, stop: Stop) -> None:
        """Nothing has moved since the stop; a press moves nothing either, but from then on the arms follow."""
        joints = self.cell.joints
        self.cell.wait_until_ready()
        time.sleep(AWHILE)
        assert joints.farthest_from(stop.posture, stop.t) < STILL
        self.operator.rest(stop.t)
        began = time.monotonic()
        self.press()
        time.sleep(AWHILE)
        assert self.cell.tools_moved(stop.posture, began) < ANCHORED  # elbows may, towards their usual posture
        self.move()
        assert max(np.abs(state.v).max() for state in joints.since(began)) < FAST


@pytest.fixture(scope="module")
def scene(domain: int, interfaces: None, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Scene]:
    """All nodes and a headset that is on."""
    folder = tmp_path_factory.mktemp("faults")
    processes = Processes(folder, os.environ)
    with spun_node(domain) as node:
        cell = TeleopCell(node, Robot.from_config(load_config(CONFIG)), processes)
        try:
            for name in NODES[:-1]:
                cell.start(name)
            address = address_of(cell.start(NODES[-1], "port:=0"))
            with Operator(address).wearing() as operator:
                yield Scene(cell, operator, address[1])
        finally:
            processes.end_all()


@pytest.fixture
def moving(scene: Scene) -> Scene:
    """Both arms follow their hands, whatever a test before has left behind."""
    for name in NODES:
        scene.mend(name)
    scene.move()
    return scene


@pytest.mark.parametrize("name", KILLED)
def test_a_killed_node_stops_both_arms_and_its_return_moves_none(
    name: str, moving: Scene, record_property: Record
) -> None:
    again = partial(moving.move_again, name)
    stop = moving.measure_stop(f"{name} killed", partial(moving.cell.kill, name), again, record_property)
    moving.cell.wait_for_diagnosis(stop.fault, KILLED[name], " for 0.")
    moving.mend(name)
    moving.assert_only_a_press_moves(stop)


def test_a_killed_robot_is_missed_and_greeted_with_no_command_of_the_past(moving: Scene) -> None:
    cell = moving.cell
    fault = cell.kill("mujoco_robot")
    cell.wait_for_diagnosis(fault, "left_tool_frame on /tf from /mujoco_robot is 0.")
    cell.wait_for_diagnosis(fault, "no joint states from /mujoco_robot for 0.1")
    eventually(lambda: cell.controller_is("inactive", fault), "the controller has braked")
    time.sleep(0.1)
    silence = time.monotonic()
    moving.mend("mujoco_robot")
    eventually(lambda: cell.joints.since(silence), "the robot is back")
    back = cell.joints.since(silence)[0]
    cell.wait_until_ready()
    time.sleep(AWHILE)
    # The controller may have found the robot before this test did; whatever it commands, it is where the robot stands.
    commands = [np.abs(q - back.q).max() for t, q in cell.commands if t > silence]
    assert commands, "the controller holds the arms where they are"
    assert max(commands) < STILL
    assert cell.joints.farthest_from(back.q, back.t) < STILL
    moving.operator.rest()
    moving.press()
    moving.move()


def test_a_script_that_died_stops_both_arms_and_its_return_waits_to_be_asked(
    scene: Scene, record_property: Record
) -> None:
    """Started by hand it plays at once, as it was asked to; started again by whatever does that, it does not."""
    cell = scene.cell
    for name in NODES:
        scene.mend(name)
    scene.operator.online = False
    try:
        eventually(lambda: not any(map(cell.engaged, ARMS)), "the headset is off")
        scene.play()
        name = "simulation_input"
        stop = scene.measure_stop(f"{name} killed", lambda: cell.kill(name), scene.play, record_property)
        cell.wait_for_diagnosis(stop.fault, "of the left hand from /simulation_input")
        cell.start("simulation_input", "start_on_request:=true")
        back = time.monotonic()
        cell.wait_for_diagnosis(back, "waits for a call of ~/start")
        time.sleep(3.0 * AWHILE)  # longer than it takes the script to press and move
        assert cell.joints.farthest_from(stop.posture, stop.t) < STILL
        cell.call("/simulation_input/start")
        eventually(lambda: cell.moving, "both arms follow again")
        assert max(np.abs(state.v).max() for state in cell.joints.since(back)) < FAST
    finally:
        cell.kill("simulation_input")
        scene.operator.rest()
        scene.operator.online = True


@pytest.mark.parametrize("name", FROZEN)
def test_a_frozen_node_stops_both_arms_and_when_it_wakes_it_moves_none(
    name: str, moving: Scene, record_property: Record
) -> None:
    freeze = partial(moving.cell.signal, name, signal.SIGSTOP)
    stop = moving.measure_stop(f"{name} frozen", freeze, partial(moving.move_again, name), record_property)
    time.sleep(max(stop.fault + 1.0 - time.monotonic(), 0.0))
    woken = moving.cell.signal(name, signal.SIGCONT)
    moving.cell.wait_for_diagnosis(woken, FROZEN[name])
    moving.assert_only_a_press_moves(stop)
