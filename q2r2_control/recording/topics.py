"""What is recorded of a run: topics and their message types.

All that a replay needs, to the bit, and all that is judged and exported is on three topics: ``tick``, ``hand_samples``
and ``state``. The others are the same once more as standard messages, for tools that plot and show them; those that ROS
nodes have too are named as theirs.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

from q2r2_control.recording.messages import ARRAY, HAND_INPUTS, JOINTS, PICTURE, POSE, TEXT, TRAJECTORY
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, tick_labels
from q2r2_control.types import SIDES

WORLD = "world"  # frame of targets
TICK, SAMPLES, STATE = "/q2r2/tick", "/q2r2/hand_samples", "/q2r2/state"
JOINT_STATES, EXTERNAL_TORQUE = "/joint_states", "/q2r2/external_torque"
JOINT_COMMANDS, REFERENCE, DESCRIPTION = "/joint_commands", "/q2r2/reference", "/robot_description"


@dataclass(frozen=True)
class Topic:
    """One topic of a recording."""

    channel: int
    name: str
    type: str
    labels: tuple[str, ...] = ()  # of an array's numbers, in their order


def run_topics(arms: Sequence[str], joints: Sequence[str], cameras: Sequence[str] = ()) -> dict[str, Topic]:
    """By name, in the order in which a tick's messages are written."""
    types = {DESCRIPTION: TEXT, TICK: ARRAY, SAMPLES: ARRAY}
    for hand in SIDES:
        types |= {hand_pose(hand): POSE, hand_buttons(hand): HAND_INPUTS}
    types |= {JOINT_STATES: JOINTS, EXTERNAL_TORQUE: JOINTS}
    for arm in arms:
        types |= {filtered_hand(arm): POSE, target(arm): POSE, safe_target(arm): POSE}
    types |= {REFERENCE: TRAJECTORY, JOINT_COMMANDS: JOINTS, STATE: TEXT}
    types |= {picture_topic(camera): PICTURE for camera in cameras}
    return numbered(types, {TICK: tick_labels(arms, joints), SAMPLES: SAMPLE_FIELDS})


def numbered(types: dict[str, str], labels: dict[str, tuple[str, ...]]) -> dict[str, Topic]:
    """Topics with channels from 1 on."""
    return {
        name: Topic(channel, name, kind, labels.get(name, ())) for channel, (name, kind) in enumerate(types.items(), 1)
    }


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


def picture_topic(camera: str) -> str:
    """The topic of a camera's pictures."""
    return f"/{camera}/image/compressed"
