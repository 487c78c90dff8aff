"""Between ROS and the package's own data: messages in and out, and whether those on the other side can be relied on.

``messages`` and ``joint_messages`` convert, with ``serialized`` where the same names come again and again; ``frames``
says where a tool is, ``link_frames`` where links are; ``intakes`` takes targets and joint states; ``joint_outputs``
sends joint commands; ``target_output`` and ``arm_outputs`` send tool poses to a controller, which ``home_client`` asks
for the way home; ``arm_pair`` is what one arm's node has in common with the other's, ``arm_feedback`` what the operator
is told, ``controller_feedback`` what the built-in controller tells; ``grippers`` commands grippers, as far as
``opening_grants`` is told by the controller, where ``gripper_limits`` decides; ``hand_topics``, ``hand_intake``,
``arm_conditions``, ``markers`` and ``distance_marker`` do one kind of topic each, ``reports`` does what is for a
recorder; ``parameters`` reads parameters, and ``live_parameters`` takes those that change. The modules are imported
when their names are first used.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

from q2r2_control._lazy import lazy_exports

if TYPE_CHECKING:
    from q2r2_control.ros.bridge.arm_outputs import ArmOutputs
    from q2r2_control.ros.bridge.frames import FrameListener, PoseTopic, ToolFrame
    from q2r2_control.ros.bridge.grippers import GripperClient, GripperServer
    from q2r2_control.ros.bridge.hand_topics import HandPublishers, HandWatch
    from q2r2_control.ros.bridge.intakes import JointIntake, TargetIntake
    from q2r2_control.ros.bridge.joint_outputs import JointOutput, make_output
    from q2r2_control.ros.bridge.markers import TargetMarkers
    from q2r2_control.ros.bridge.parameters import ArmParameters, arm_parameters
    from q2r2_control.ros.bridge.target_output import TargetOutput

__all__ = [
    "ArmOutputs",
    "ArmParameters",
    "FrameListener",
    "GripperClient",
    "GripperServer",
    "HandPublishers",
    "HandWatch",
    "JointIntake",
    "JointOutput",
    "PoseTopic",
    "TargetIntake",
    "TargetMarkers",
    "TargetOutput",
    "ToolFrame",
    "arm_parameters",
    "make_output",
]

__getattr__ = lazy_exports(
    __name__,
    {
        "ArmOutputs": "arm_outputs",
        "ArmParameters": "parameters",
        "FrameListener": "frames",
        "GripperClient": "grippers",
        "GripperServer": "grippers",
        "HandPublishers": "hand_topics",
        "HandWatch": "hand_topics",
        "JointIntake": "intakes",
        "JointOutput": "joint_outputs",
        "PoseTopic": "frames",
        "TargetIntake": "intakes",
        "TargetMarkers": "markers",
        "TargetOutput": "target_output",
        "ToolFrame": "frames",
        "arm_parameters": "parameters",
        "make_output": "joint_outputs",
    },
)
