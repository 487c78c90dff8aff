"""What is recorded: the topics, their message types, and what each number of an array stands for.

Topics that ROS nodes have too are named as theirs. Those below ``/q2r2/`` hold what only the loop itself knows:
``run_start``, ``tick``, ``hand_samples``, ``joint_states`` and ``external_torque`` are all that the loop took, to the
bit, so that a replay can give it the same again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from q2r2_control.recording.rows import RowType, float_array, hand_inputs, joint_state, joint_trajectory, pose_stamped
from q2r2_control.types import SIDES

WORLD = "world"  # frame of targets
TICK, SAMPLES, START = "/q2r2/tick", "/q2r2/hand_samples", "/q2r2/run_start"
JOINT_STATES, EXTERNAL_TORQUE = "/joint_states", "/q2r2/external_torque"
JOINT_COMMANDS, REFERENCE = "/joint_commands", "/q2r2/reference"
GRIPPERS, FLAGS, STATE, DESCRIPTION = "/q2r2/grippers", "/q2r2/flags", "/q2r2/state", "/robot_description"

_ARRAY, _TEXT, PICTURE = "std_msgs/msg/Float64MultiArray", "std_msgs/msg/String", "sensor_msgs/msg/CompressedImage"
_POSE, _JOINTS = "geometry_msgs/msg/PoseStamped", "sensor_msgs/msg/JointState"

SAMPLE_FIELDS = (
    *("tick", "hand", "pose_stamp", "inputs_stamp", "x", "y", "z", "qx", "qy", "qz", "qw", "button_upper"),
    *("button_lower", "thumb_stick_horizontal", "thumb_stick_vertical", "press_index", "press_middle"),
    "fault",
)
# Of the tick topic. Those behind `opening_<arm>`, as measured: how long it took, which no replay repeats.
_TICK_FIELDS = (
    *("index", "now", "dt", "step", "state_stamp", "following", "connected", "samples", "external", "unsolved"),
    "command_mode",
)
TIMINGS = ("compute_time", "solve_time")
_START_FIELDS = ("now", "state_stamp", "external")
_FLAG_FIELDS = ("status", "certified", "fallback", "closest_distance", "margin", "slack")
_ARM_FLAG_FIELDS = ("engaged", "rejected", "slip", "slip_angle", "gripper_held", "holding")
_GRIPPER_FIELDS = ("wanted", "commanded", "measured")


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    channel: int
    name: str
    type: str
    row: RowType | None = None  # None: of any length, std_msgs/String or PICTURE
    labels: dict[str, tuple[str, ...]] = field(default_factory=dict)  # of a field's numbers, in their order


class Topics:
    """All topics for arms, joints and cameras of these names, in the order in which a tick's messages are written."""

    def __init__(self, arms: Sequence[str], joints: Sequence[str], cameras: Sequence[str] = ()) -> None:
        self.arms, self.joints = tuple(arms), tuple(joints)
        self.all: list[Topic] = []
        measured = tuple(f"{what}_{name}" for what in ("q", "v", "tau", "tau_external") for name in joints)
        joint_lists = {"position": joints, "velocity": joints, "effort": joints}
        self._add(DESCRIPTION, _TEXT)
        self._add_array(START, (*_START_FIELDS, *measured))
        openings = tuple(f"opening_{arm}" for arm in arms)
        self._add_array(TICK, (*_TICK_FIELDS, *openings, *TIMINGS))
        self._add_array(SAMPLES, SAMPLE_FIELDS)
        for hand in SIDES:
            self._add(hand_pose(hand), _POSE, pose_stamped(""))
            self._add(hand_buttons(hand), "quest2ros/msg/OVR2ROSInputs", hand_inputs())
        self._add(JOINT_STATES, _JOINTS, joint_state(joints, *joint_lists), joint_lists)
        self._add(EXTERNAL_TORQUE, _JOINTS, joint_state(joints, "effort"), {"effort": joints})
        for arm in arms:
            self._add(filtered_hand(arm), _POSE, pose_stamped(""))
            self._add(target(arm), _POSE, pose_stamped(WORLD))
            self._add(safe_target(arm), _POSE, pose_stamped(WORLD))
        motion = {"positions": joints, "velocities": joints, "accelerations": joints}
        self._add(REFERENCE, "trajectory_msgs/msg/JointTrajectory", joint_trajectory(joints), motion)
        self._add(JOINT_COMMANDS, _JOINTS, joint_state(joints, *joint_lists), joint_lists)
        self._add_array(GRIPPERS, tuple(f"{what}_{arm}" for arm in arms for what in _GRIPPER_FIELDS))
        flags = tuple(f"{what}_{arm}" for arm in arms for what in _ARM_FLAG_FIELDS)
        self._add_array(FLAGS, (*_FLAG_FIELDS, *flags))
        self._add(STATE, _TEXT)
        for camera in cameras:
            self._add(picture(camera), PICTURE)
        self.by_name = {topic.name: topic for topic in self.all}
        self.by_channel = {topic.channel: topic for topic in self.all}

    def _add_array(self, name: str, labels: Sequence[str]) -> None:
        self._add(name, _ARRAY, float_array(len(labels)), {"data": labels})

    def _add(
        self, name: str, type: str, row: RowType | None = None, labels: dict[str, Sequence[str]] | None = None
    ) -> None:
        named = {key: tuple(values) for key, values in (labels or {}).items()}
        self.all.append(Topic(len(self.all) + 1, name, type, row, named))


def hand_pose(hand: str) -> str:
    """The topic of a hand's poses."""
    return f"/q2r_{hand}_hand_pose"


def hand_buttons(hand: str) -> str:
    """The topic of a hand's buttons, triggers and stick."""
    return f"/q2r_{hand}_hand_inputs"


def filtered_hand(arm: str) -> str:
    """The topic of the filtered poses of the hand that an arm follows."""
    return f"/q2r2/{arm}/filtered_hand_pose"


def target(arm: str) -> str:
    """The topic of what the operator asks of an arm."""
    return f"/q2r2/{arm}/target_frame"


def safe_target(arm: str) -> str:
    """The topic of an arm's tool at the controller's reference."""
    return f"/cartesian_controller/safe_target/{arm}"


def picture(camera: str) -> str:
    """The topic of a camera's pictures."""
    return f"/{camera}/image/compressed"
