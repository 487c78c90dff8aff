"""What is told of one arm's teleoperation: to its hand as vibrations, to the log, to RViz, to a recording."""

from __future__ import annotations

import pinocchio as pin
from visualization_msgs.msg import Marker

from q2r2_control.events import Event
from q2r2_control.ros.base_node import BaseNode
from q2r2_control.ros.bridge.gripper_client import GripperClient
from q2r2_control.ros.bridge.hand_intake import HandIntake
from q2r2_control.ros.bridge.markers import TargetMarkers
from q2r2_control.ros.bridge.parameters import ArmParameters
from q2r2_control.ros.bridge.reports import ArmReport
from q2r2_control.teleop.arm_states import AT_REST, is_refusal
from q2r2_control.teleop.haptics import HapticPulses
from q2r2_control.teleop.steady_state_offset import with_offset
from q2r2_control.types import ArmTarget
from q2r2_control.wording import event_line

_MARKER_PERIOD = 0.05  # [s]


class ArmFeedback:
    """Keeps what was told last."""

    def __init__(self, node: BaseNode, arm: str, values: ArmParameters, hand: HandIntake) -> None:
        self._node, self._hand = node, hand
        self.haptics = HapticPulses(values.teleop.haptics)
        self.last_line, self.last_kind = "not engaged yet", ""  # of the last event; the kind of its first cause
        self.paused = "not engaged yet"  # by the last event that let the arm hold
        self._drawn = TargetMarkers(arm, values.tool_frame, values.world_frame)
        self._markers = node.create_publisher(Marker, "/visualization_marker", 10)
        self._shown = 0.0
        self._report = ArmReport(node, arm)

    def tell(self, event: Event) -> None:
        """Report a change of the state: to the log, and to the hand as vibrations."""
        self.last_line, self.last_kind = event_line(event), str(event.reason.root.kind)
        if event.destination in AT_REST and not is_refusal(event):
            self.paused = self.last_line
        self._node.get_logger().info(self.last_line)
        self.haptics.tell(event)
        self._report.tell(event)
        self._node.report_health()

    def publish(
        self,
        engaged: bool,
        target: ArmTarget,
        sent: pin.SE3 | None,
        tool: pin.SE3 | None,
        gripper: GripperClient,
        hand: str,
        now: float,
    ) -> None:
        """Of one tick at ``now`` [s]: what the ``target`` has become, ``sent`` to the controller, world frame."""
        self._report.publish(engaged, target, gripper.opening, now)
        self.haptics.slip(target.slip, target.slip_angle)
        self.haptics.grasps(gripper.holds)
        if (pulse := self.haptics.at(now, hand)) is not None:
            self._hand.feel(pulse)
        if not 0.0 <= now - self._shown < _MARKER_PERIOD:
            self._shown = now
            if not self._markers.get_subscription_count():
                return
            asked = None if sent is None else with_offset(sent, target.offset)  # where the tool is to be
            for marker in self._drawn.at(asked, tool, engaged, now):
                self._markers.publish(marker)
