"""Recordings of ROS nodes whose every message is known: written by the recorder's own writer, without ROS."""

from __future__ import annotations

import json
import time
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import numpy as np

from q2r2_control import Robot
from q2r2_control.config.cell import Config
from q2r2_control.events import Event, Reason, ReasonKind
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import ROS, About, as_yaml
from q2r2_control.recording.base_recorder import ROOM, MessageRecorder
from q2r2_control.recording.messages import (
    TEXT,
    Message,
    float_array,
    joint_state,
    joint_trajectory,
    make,
    pose_stamped,
    serialized,
)
from q2r2_control.recording.topics import (
    CONTROLLER_TICK,
    RECORDER_EVENTS,
    arm_events,
    arm_flags,
    ros_topics,
    tick_fields,
)
from q2r2_control.types import Array
from tests.support.processes import cell

PERIOD = 4_000_000  # of ticks [ns]
LATENCY = 100_000  # from a tick to the receipt of what it sends [ns]


class NodesOnFile:
    """Messages of nodes at times since the recording began [ns]."""

    def __init__(self, folder: Path, config: Config | None = None, room: int = ROOM) -> None:
        self.config = (config or cell()).model_copy(update={"loop_rate_hz": 250.0})
        self.robot = Robot.from_config(self.config)
        self.arms, self.joints = tuple(self.robot.arms), tuple(self.robot.joint_names)
        self.epoch = time.time_ns()
        self.recorder = MessageRecorder(folder, self.config.name, room)
        about = About(
            *(self.arms, self.joints, "", (), self.epoch, True, as_yaml(self.config), self.robot.urdf),
            cameras=tuple(self.config.cameras),
            notes={"task": "to count"},
            source=ROS,
        )
        topics = ros_topics(self.arms, {name: camera.topic or "" for name, camera in self.config.cameras.items()})
        self.topics = {topic.name: topic for topic in topics}
        self.recorder.begin(about, topics)
        self._number = 0

    def close(self) -> Path:
        """The file, whole."""
        self.recorder.finish()
        assert self.recorder.fault is None
        assert self.recorder.file is not None
        return self.recorder.file

    def put(self, topic: str, at: int, message: Any) -> None:
        self._number += 1
        time, payload = self.epoch + at, serialized(self.topics[topic].type, message)
        self.recorder.record([Message(self.topics[topic].channel, self._number, time, time, payload)])

    def joint_states(self, at: int, q: Array, extra: Iterable[str] = ("left_finger_joint_1",)) -> None:
        """Joints in another order than the robot's, and some that are not its own."""
        order = [*reversed(self.joints), *extra]
        values = dict(zip(self.joints, q, strict=True))
        position = np.array([values.get(name, 0.5) for name in order])
        self.put(
            names.JOINT_STATES,
            at,
            joint_state(order, position, 0 * position, 0 * position),
        )

    def tick(self, at: int, index: int, q: Array, v: Array | None = None, **values: float) -> None:
        """A tick of the controller: its reference, and what it says of it."""
        now = (self.epoch + at) * 1e-9
        zero = np.zeros(len(self.joints))
        reference = joint_trajectory(list(self.joints), q, zero if v is None else v, zero, round(now * 1e9))
        self.put(names.REFERENCE, at + LATENCY, reference)
        numbers = dict.fromkeys(tick_fields(self.arms), 0.0)
        numbers |= {"index": index, "now": now, "dt": PERIOD * 1e-9, "step": PERIOD * 1e-9, "certified": 1.0}
        numbers |= {"closest_distance": 0.2, "margin": 0.18} | values
        self.put(CONTROLLER_TICK, at + LATENCY, float_array(np.array(list(numbers.values()))))

    def flags(self, at: int, arm: str, engaged: bool, wanted: float = 1.0, measured: float = 1.0) -> None:
        self.put(arm_flags(arm), at, float_array(np.array([engaged, 0.0, 0.0, wanted, measured])))

    def target(self, at: int, arm: str, x: float) -> None:
        self.put(names.target(arm), at, self._pose(at, x))

    def hand(self, at: int, hand: str, x: float) -> None:
        self.put(names.hand_pose(hand), at, self._pose(at, x))

    def _pose(self, at: int, x: float) -> Any:
        return pose_stamped(np.array([x, 0.0, 0.5, 0.0, 0.0, 0.0, 1.0]), stamp=self.epoch + at)

    def event(
        self, at: int, kind: ReasonKind, arm: str | None = "left", source: str = "", destination: str = ""
    ) -> None:
        """Of an arm, or of the recorder's services."""
        topic = RECORDER_EVENTS if arm is None else arm_events(arm)
        event = Event(123.0, arm or "", source, destination, Reason(kind))  # its sender's clock is not used
        self.put(topic, at, make(TEXT, json.dumps(event.as_json())))
