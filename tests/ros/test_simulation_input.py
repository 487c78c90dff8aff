"""The scripted hands as other processes receive them, compared with the script itself."""

from __future__ import annotations

import json
import time
from queue import Queue
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.types import Array
from tests.ros.conftest import need_ros
from tests.ros.processes import PATIENCE, Processes, States, as_arguments, drained, subscribed, wait_until

need_ros()

from std_msgs.msg import String

from q2r2_control.ros.bridge.messages import seconds
from q2r2_control.ros.nodes.simulation_input import SimulationInput
from q2r2_control.types import HandSample

RATE = 50.0  # [Hz]


def start(processes: Processes, **parameters: object) -> Any:
    return processes.start_node("SimulationInput", *(f"{name}:={value}" for name, value in parameters.items()))


def subscribe(node: Any, hand: str) -> dict[str, Queue[Any]]:
    from geometry_msgs.msg import PoseStamped, Twist
    from quest2ros.msg import OVR2ROSInputs

    kinds = {"pose": PoseStamped, "twist": Twist, "inputs": OVR2ROSInputs}
    return {name: subscribed(node, kind, f"q2r_{hand}_hand_{name}") for name, kind in kinds.items()}


def assert_a_part_of(received: Array, script: Array) -> None:
    """Assert that ``received`` contains successive rows of ``script``. The first rows may be lost before discovery."""
    starts = range(len(script) - len(received) + 1)
    assert min(float(np.abs(script[start : start + len(received)] - received).max()) for start in starts) <= 1e-6


def test_received_poses_inputs_and_twists_equal_the_poses_inputs_and_twists_of_the_script(
    node: Any, processes: Processes
) -> None:
    queues = subscribe(node, "right")
    start(processes, side="right", trajectory="rotate", rate=RATE)
    wait_until(lambda: all(queue.qsize() >= 300 for queue in queues.values()), "six seconds of each topic")
    poses, inputs, twists = (drained(queues[suffix])[:300] for suffix in ("pose", "inputs", "twist"))
    # At first, the hand rests, because no arm has reported yet.
    press = next(i for i, message in enumerate(inputs) if message.button_lower)
    poses, inputs, twists = (messages[press - 20 : press + 130] for messages in (poses, inputs, twists))

    script = ScriptedInput("rotate", ["right"], rate_hz=RATE)
    script.start()
    expected = [sample for k in range(6) for sample in script.poll(float(k))]
    placed = [m.pose.position for m in poses], [m.pose.orientation for m in poses]
    received = np.array([[p.x, p.y, p.z, q.x, q.y, q.z, q.w] for p, q in zip(*placed, strict=True)])
    assert_a_part_of(received, np.array([[*sample.position, *sample.quaternion] for sample in expected]))
    stamps = np.array([seconds(m.header.stamp) for m in poses])
    np.testing.assert_allclose(np.diff(stamps), 1.0 / RATE, atol=1e-6)

    pressed = np.array([[float(m.button_lower), float(m.button_upper)] for m in inputs])
    assert 0.0 < pressed[:, 0].sum() * (1.0 / RATE) < 0.3, "the lower button is pressed to engage, and let go"
    assert_a_part_of(pressed, np.array([[s.inputs.button_lower, s.inputs.button_upper] for s in expected], dtype=float))
    moved = [(m.linear, m.angular) for m in twists]
    velocities = np.array([[v.x, v.y, v.z, w.x, w.y, w.z] for v, w in moved])
    assert np.abs(velocities[:, :3]).max() > 0.05
    assert np.abs(velocities[:, 3:]).max() > 0.1
    motions = [script.hand_twist("right", s.pose_stamp) for s in expected]
    assert_a_part_of(velocities, np.array([[*m.linear, *m.angular] for m in motions]))


def test_the_script_waits_until_both_hands_have_subscribers(node: Any, processes: Processes) -> None:
    states = States(node, "simulation_input")
    left = subscribe(node, "left")
    process = start(processes, side="both", frame_id="room")
    assert states.wait_for(without_subscriber=["right"])["samples"] == 0
    time.sleep(0.2)
    assert left["pose"].empty()
    for queues in (subscribe(node, "right"), left):
        assert queues["pose"].get(timeout=PATIENCE).header.frame_id == "room"
    states.wait_for(level="ok", without_subscriber=[])
    assert process.interrupt() == 0


def speaking_arm(node: Any, ready: bool, message: str) -> dict[str, Any]:
    """Return the report of the left hand's arm, which this node sends ten times a second. Tests change it."""
    arm = {"level": "ok", "hand": "left", "engaged": False, "ready": ready, "message": message, "last_event": ""}
    said = node.create_publisher(String, f"{node.get_fully_qualified_name()}/state", 10)
    node.create_timer(0.1, lambda: said.publish(String(data=json.dumps(arm))))
    return arm


def test_the_script_waits_for_a_ready_arm_and_presses_until_it_follows(node: Any, processes: Processes) -> None:
    arm = speaking_arm(node, ready=False, message="no tool yet")
    states, left = States(node, "simulation_input"), subscribe(node, "left")
    start(processes, side="left", trajectory="line")
    states.wait_for(level="warn", without_subscriber=[])
    time.sleep(2.0)
    held = drained(left["pose"])
    assert not any(message.button_lower for message in drained(left["inputs"])), "nothing is pressed meanwhile"
    assert len({message.pose.position.x for message in held}) == 1, "the hand rests, and is there"

    arm |= {"ready": True, "message": "ready to engage"}
    for _ in range(2):
        wait_until(lambda: left["inputs"].get(timeout=PATIENCE).button_lower, "the button is pressed")
        wait_until(lambda: not left["inputs"].get(timeout=PATIENCE).button_lower, "the button is let go")
    assert len({message.pose.position.x for message in drained(left["pose"])}) == 1
    arm["engaged"] = True
    rest = left["pose"].get(timeout=PATIENCE).pose.position.x
    wait_until(lambda: left["pose"].get(timeout=PATIENCE).pose.position.x > rest + 0.02, "the hand moves")
    arm |= {"engaged": False, "ready": False}  # A fault stops the arm, which is then not ready for a moment.
    wait_until(lambda: left["pose"].get(timeout=PATIENCE).pose.position.x == rest, "the hand is where it was")
    drained(left["inputs"])
    time.sleep(0.5)
    assert not any(message.button_lower for message in drained(left["inputs"]))
    arm["ready"] = True
    wait_until(lambda: left["inputs"].get(timeout=PATIENCE).button_lower, "the button is pressed")
    arm["engaged"] = True
    time.sleep(7.0)
    arm["engaged"] = False  # From now on, only a person can engage the arm.
    time.sleep(0.5)
    drained(left["inputs"])
    time.sleep(2.0)
    assert not any(message.button_lower for message in drained(left["inputs"]))


class PlayedHand(SimulationInput):
    """A scripted left hand. The test sets its clock and the report of its arm."""

    now = 0.0

    def __init__(self, trajectory: str, context: Any) -> None:
        super().__init__(context=context, cli_args=as_arguments("side:=left", f"trajectory:={trajectory}"))
        self.arm = {"hand": "left", "engaged": False, "ready": True, "last_event_kind": "reset_service", "message": ""}
        self.controller = {"requests": 3, "ceased_kind": ""}
        self.presses, self._held = 0, False
        self._hand_publishers: Any = SimpleNamespace(publish_sample=self._count, subscribers=lambda hand: 1, sent={})

    def _count(self, sample: HandSample, *_: object) -> None:
        self.presses += sample.inputs.button_lower and not self._held
        self._held = sample.inputs.button_lower

    def play(self, until: float, **said: object) -> int:
        self.arm |= said
        while self.now < until:
            self._listeners._states.newest |= {
                "/arm": (self.arm, time.monotonic()),
                "/controller": (self.controller, time.monotonic()),
            }
            self.now += 0.02
            self._tick()
        return self.presses


@pytest.mark.parametrize(
    ("kind", "presses"), [("states_silent", 4), ("pause_service", 1), ("reset_service", 1), ("homing_arrived", 1)]
)
def test_an_arm_is_not_engaged_again_after_a_request_of_another_program(kind: str, presses: int, context: Any) -> None:
    hand = PlayedHand("line", context)
    assert hand.play(0.9) == 1, "what was asked for before does not count"
    hand.play(1.3, last_event_kind="no_subscriber")  # The press was refused, and the script begins again.
    assert hand.play(5.0, last_event_kind=kind) == presses
    hand.destroy_node()


@pytest.mark.parametrize("engaged", [True, False])
def test_the_last_press_of_a_script_may_pause_an_arm_and_engages_no_arm(engaged: bool, context: Any) -> None:
    hand = PlayedHand("meet", context)
    hand.play(0.9)
    assert hand.play(9.0, engaged=True, last_event_kind="pressed") == 1
    assert hand.play(60.0, engaged=engaged) == 1 + engaged
    hand.destroy_node()


def following_hand(context: Any) -> PlayedHand:
    """Return a hand that has moved its arm for longer than the time in which it engages the arm after any stop."""
    hand = PlayedHand("circle", context)
    hand.play(0.9)
    hand.play(20.0, engaged=True, state="engaged", last_event_kind="pressed")
    return hand


def lost(kind: str, **more: object) -> dict[str, object]:
    return {"engaged": False, "state": "lost", "last_event_kind": kind, "paused_kind": kind} | more


@pytest.mark.parametrize(
    ("kind", "ceased", "presses"),
    [
        ("node_stalled", "targets_ceased", 1),
        ("hand_silent", "", 1),
        ("followed_no_more", "loop_stalled", 1),
        ("not_acknowledged", "states_silent", 1),
        ("followed_no_more", "", 0),
        ("followed_no_more", "controller_stands", 0),
        ("node_stalled", "new_receiver", 0),
        ("hand_jumped", "targets_ceased", 0),
        ("several_publishers", "targets_ceased", 0),
        ("pause_service", "targets_ceased", 0),
    ],
)
def test_a_lost_arm_is_engaged_again_only_if_something_was_late(
    kind: str, ceased: str, presses: int, context: Any
) -> None:
    hand = following_hand(context)
    hand.controller["ceased_kind"] = ceased
    assert hand.play(21.0, **lost(kind)) == 1 + presses
    hand.destroy_node()


def test_a_lost_arm_is_not_engaged_by_the_script_after_a_call_of_a_controller_service(context: Any) -> None:
    hand = following_hand(context)
    hand.controller |= {"requests": 4, "ceased_kind": "targets_ceased"}
    assert hand.play(30.0, **lost("node_stalled")) == 1
    hand.destroy_node()


def test_if_a_lost_arm_is_ready_too_late_only_a_person_can_engage_it_and_the_report_says_how(context: Any) -> None:
    hand = following_hand(context)
    assert hand.play(22.9, **lost("hand_silent", ready=False)) == 1
    assert "engage" not in hand.health()[1]
    assert hand.play(30.0, ready=True, message="ready to engage") == 1
    assert "call /arm/engage" in hand.health()[1]
    hand.play(40.0, engaged=True, state="engaged")
    assert "engage" not in hand.health()[1]
    hand.play(42.9, **lost("hand_silent"))
    assert "engage" not in hand.health()[1], "a person may engage the arm again before the line comes"
    hand.play(43.1)
    assert "call /arm/engage" in hand.health()[1]
    hand.destroy_node()
