"""What stops an arm, and what keeps one from starting: the same rules for the pipeline and the ROS nodes.

``supervisor`` decides at every tick what the controller is asked for and whether the arms may move; ``joint_watch``
judges measured states, ``targets`` and ``target_stream`` who is followed, ``target_line`` where to, ``tick_clock`` when
a tick counts, ``tick_pacer`` what a late one may move, ``delay_watch`` and ``sequence_watch`` whether a message is of
the past, or of another sender. ``homing`` leads arms without targets, by ``joint_homing`` or ``tool_homing``;
``external_arms`` are those that another controller moves.
``preflight`` looks at a cell before it runs, and ``target_guard`` limits targets for controllers that have no limits of
their own. For loops that drive grippers, as the pipeline does, there are ``gripper_limiter`` and ``grasp_watch``. No
ROS and no clock in here.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.supervision.delay_watch import DelayWatch
    from q2r2_control.supervision.external_arms import ExternalArms
    from q2r2_control.supervision.grasp_watch import GraspWatch
    from q2r2_control.supervision.gripper_limiter import GripperLimiter
    from q2r2_control.supervision.homing import Homing
    from q2r2_control.supervision.joint_homing import JointHoming
    from q2r2_control.supervision.joint_watch import JointWatch, WatchSettings, watch_settings
    from q2r2_control.supervision.preflight import preflight_faults
    from q2r2_control.supervision.sequence_watch import SequenceWatch
    from q2r2_control.supervision.supervisor import Phase, Supervisor
    from q2r2_control.supervision.target_guard import TargetGuard
    from q2r2_control.supervision.target_stream import Origins, Refusal, StreamSettings, TargetStream
    from q2r2_control.supervision.tick_clock import TickClock
    from q2r2_control.supervision.tick_pacer import TickPacer
    from q2r2_control.supervision.tool_homing import ToolHoming

__all__ = [
    "DelayWatch",
    "ExternalArms",
    "GraspWatch",
    "GripperLimiter",
    "Homing",
    "JointHoming",
    "JointWatch",
    "Origins",
    "Phase",
    "Refusal",
    "SequenceWatch",
    "StreamSettings",
    "Supervisor",
    "TargetGuard",
    "TargetStream",
    "TickClock",
    "TickPacer",
    "ToolHoming",
    "WatchSettings",
    "preflight_faults",
    "watch_settings",
]

# Only those that drive arms need the controller and its kernels.
__getattr__ = lazy_exports(
    __name__,
    {
        "DelayWatch": "delay_watch",
        "ExternalArms": "external_arms",
        "GraspWatch": "grasp_watch",
        "GripperLimiter": "gripper_limiter",
        "Homing": "homing",
        "JointHoming": "joint_homing",
        "JointWatch": "joint_watch",
        "Origins": "target_stream",
        "Phase": "supervisor",
        "Refusal": "target_stream",
        "SequenceWatch": "sequence_watch",
        "StreamSettings": "target_stream",
        "Supervisor": "supervisor",
        "TargetGuard": "target_guard",
        "TargetStream": "target_stream",
        "TickClock": "tick_clock",
        "TickPacer": "tick_pacer",
        "ToolHoming": "tool_homing",
        "WatchSettings": "joint_watch",
        "preflight_faults": "preflight",
        "watch_settings": "joint_watch",
    },
)
