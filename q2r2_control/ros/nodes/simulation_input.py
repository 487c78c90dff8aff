"""``SimulationInput``: publishes the messages of a headset from a script, for tests with an input free of tremor."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import Any

from std_srvs.srv import Trigger

from q2r2_control.inputs.messages import HandMessage, HandPose, HandTwist, MessageType
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.inputs.session import HAND_TOPICS
from q2r2_control.inputs.trajectories import TRAJECTORIES
from q2r2_control.ros.base_node import OK, WARN, BaseNode, run_node
from q2r2_control.ros.bridge.hand_topics import HandPublishers
from q2r2_control.types import SIDES, HandSample

_PERIOD = 0.002  # samples that came due are published this often [s]
_MODES = {
    "all": (MessageType.POSE, MessageType.INPUTS, MessageType.TWIST),
    "teleop": (MessageType.POSE, MessageType.INPUTS),
    "velocity": (MessageType.TWIST,),
}


class SimulationInput(BaseNode):
    """Plays a scripted trajectory. It presses and releases the lower buttons once, early on, to engage the arms.

    So the script starts only when every hand that it plays has a subscriber, unless ``wait_for_subscribers`` is false.

    A user who starts the node asks for the motion, as an operator does with a button. A launch file that restarts the
    node after a crash does not, and the arms that the crash has stopped must not move then. Use ``start_on_request``
    there: after each start nothing is published until ``~/start`` is called.
    """

    def __init__(self, **kwargs: Any) -> None:
        super().__init__("simulation_input", **kwargs)
        side = self.parameter("side", "both", "Which hands move.", one_of=(*SIDES, "both"))
        mode = self.parameter(
            "mode", "all", "teleop: poses and inputs; velocity: twists; all: all three.", one_of=tuple(_MODES)
        )
        trajectory = self.parameter("trajectory", "circle", "What the hands do.", one_of=tuple(TRAJECTORIES))
        rate = self.parameter("rate", 75.0, "Samples of each hand [Hz].", at_least=1.0, at_most=250.0)
        self._frame = self.parameter("frame_id", "", "Frame of the poses; a headset gives none.")
        self._waits_for_subscribers = self.parameter(
            "wait_for_subscribers", True, "Start when every hand has a subscriber."
        )
        self._waits_for_request = self.parameter(
            "start_on_request", False, "Start when ~/start is called, and not before."
        )
        self._hands = SIDES if side == "both" else (side,)
        self._title = f"{trajectory} of {' and '.join(self._hands)}"
        self._topics = {
            (topic.hand, topic.kind): name
            for name, topic in HAND_TOPICS.items()
            if topic.hand in self._hands and topic.kind in _MODES[mode]
        }
        self._publishers_of_hands = HandPublishers(self, self._topics.values())
        self._samples = 0
        self._script = ScriptedInput(trajectory, self._hands, rate_hz=rate)
        self._script.start()
        self.create_service(Trigger, "~/start", self._on_start)
        self.create_timer(_PERIOD, self._play)

    def health(self) -> tuple[bytes, str, Mapping[str, Any]]:
        """What is played, or which subscriber is missing."""
        values = {"samples": self._samples}
        if self._waits_for_request:
            return WARN, "waits for a call of ~/start", values
        if self._waits_for_subscribers:
            return WARN, f"waits for a subscriber of {' and '.join(self._missing())}", values
        return OK, self._title, values

    def _missing(self) -> list[str]:
        return [f"the {hand} hand" for hand in self._hands if not self._publishers_of_hands.subscribers(hand)]

    def _on_start(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        response.success, response.message = (
            self._waits_for_request,
            "starts" if self._waits_for_request else "has started before",
        )
        self._waits_for_request = False
        return response

    def _play(self) -> None:
        if self._waits_for_request:
            return
        if self._waits_for_subscribers:
            if self._missing():
                return
            self._waits_for_subscribers = False
            self.get_logger().info(f"plays {self._title}")
        for sample in self._script.poll(self.now):
            self._publish(sample)

    def _publish(self, sample: HandSample) -> None:
        twist = self._script.hand_twist(sample.hand, sample.pose_stamp)
        messages: dict[MessageType, HandMessage] = {
            MessageType.POSE: HandPose(sample.position, sample.quaternion, sample.pose_stamp, self._frame),
            MessageType.INPUTS: sample.inputs,
            MessageType.TWIST: HandTwist(twist.linear, twist.angular),
        }
        for kind, message in messages.items():
            if (topic := self._topics.get((sample.hand, kind))) is not None:
                self._publishers_of_hands.publish(topic, message, self._frame, sample.pose_stamp)
        self._samples += 1


def main() -> int:
    """Run the node."""
    return run_node(SimulationInput)


if __name__ == "__main__":
    sys.exit(main())
