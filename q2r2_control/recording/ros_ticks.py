"""Ticks out of messages of the ROS nodes, with the rows that a recorded loop has.

A tick is one of the controller's node. With it counts what had been received by then: the newest joint states, flags of
the arms, and targets. The reference is the one with the same time.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field
from functools import partial
from typing import Any, NamedTuple

import numpy as np

from q2r2_control.config.timeouts import STREAM_TIMEOUT
from q2r2_control.events import Event
from q2r2_control.inputs.messages import Dialect, message_types
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import About
from q2r2_control.recording.reader import RecordedChunk
from q2r2_control.recording.recorded_robot import tool_poses
from q2r2_control.recording.ros_topics import (
    ARM_FIELDS,
    CONTROLLER_TICK,
    RECORDER_EVENTS,
    arm_events,
    arm_flags,
    ros_topics,
    tick_fields,
)
from q2r2_control.recording.rows import Rows, text_record
from q2r2_control.recording.topics import SAMPLE_FIELDS, Topics
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array

_SAME = 1e-6  # times of one tick may differ by their rounding [s]
_NANOSECONDS = 1_000_000_000
_WANTED, _MEASURED = ARM_FIELDS.index("wanted"), ARM_FIELDS.index("measured")


class Message(NamedTuple):
    """One message, not read yet."""

    topic: str
    time: int  # of its receipt [ns of day]
    payload: bytes


@dataclass(slots=True)
class _Tick:
    """What was known at a tick of the controller."""

    time: int  # of its receipt [ns of day]
    values: dict[str, float]  # by the names of tick_fields
    joints: Array  # (3, joints) measured q, v, tau
    flags: Array  # (arms, numbers of ARM_FIELDS)
    targets: dict[str, Array]  # (7,) of arms that have one
    samples: list[Array] = field(default_factory=list)  # numbers of SAMPLE_FIELDS, received since the last tick
    events: list[Event] = field(default_factory=list)  # since the last tick
    reference: Array = field(default_factory=lambda: np.empty(0))  # (3, joints) q, v, a
    number: int = 0


class RosTicks:
    """Takes the messages of a recording in their order, and gives rows of its ``topics``."""

    def __init__(self, about: About, topics: Topics, robot: Robot) -> None:
        self._topics, self._robot, self._epoch = topics, robot, about.epoch
        self._arms, self._joint_names = about.arms, about.joints
        self._fields = tick_fields(about.arms)
        self._types = {topic.name: topic.type for topic in ros_topics(about.arms, {})}
        self._store = message_types(Dialect.ROS2)
        self._joints = np.full((3, len(about.joints)), np.nan)
        self._flags = np.full((len(about.arms), len(ARM_FIELDS)), np.nan)
        self._targets: dict[str, tuple[int, Array]] = {}
        self._samples: list[Array] = []
        self._events: list[Event] = []
        self._due: deque[_Tick] = deque()  # wait for their references
        self._references: deque[tuple[float, Array]] = deque()  # by the controller's time [s]
        self._last_index, self._number = 0, -1  # of the newest tick
        self._take: dict[str, Callable[[Any, int], None]] = {
            names.JOINT_STATES: self._on_joints,
            names.REFERENCE: self._on_reference,
            CONTROLLER_TICK: self._on_tick,
            RECORDER_EVENTS: self._on_event,
        }
        for row, arm in enumerate(about.arms):
            self._take[names.target(arm)] = partial(self._on_target, arm)
            self._take[arm_flags(arm)] = partial(self._on_flags, row)
            self._take[arm_events(arm)] = self._on_event
        for side, hand in enumerate(SIDES):
            self._take[names.hand_pose(hand)] = partial(self._on_hand, side)

    def take(self, messages: Iterable[Message]) -> RecordedChunk:
        """The ticks that are known after some more messages; there may be none."""
        for topic, time, payload in messages:
            if (take := self._take.get(topic)) is not None:
                take(self._store.deserialize_cdr(payload, self._types[topic]), time)
        ticks = list(self._whole_ticks())
        return self._chunk(ticks) if ticks else RecordedChunk({}, {})

    def rest(self, last: RecordedChunk | None) -> RecordedChunk:
        """The ``last`` chunk, or one without a tick, with what happened after it."""
        chunk = last or RecordedChunk({}, {})
        if events := [*(event for tick in self._due for event in tick.events), *self._events]:
            state = self._state(max(self._number, 0), self._epoch, events)
            chunk.texts.setdefault(names.STATE, []).append(state)
        return chunk

    def _on_joints(self, message: Any, _: int) -> None:
        columns = {name: column for column, name in enumerate(message.name)}
        for index, name in enumerate(self._joint_names):
            if (column := columns.get(name)) is not None:
                for row, values in enumerate((message.position, message.velocity, message.effort)):
                    self._joints[row, index] = values[column] if len(values) else 0.0

    def _on_reference(self, message: Any, _: int) -> None:
        stamp, point = message.header.stamp, message.points[0]
        values = np.array([point.positions, point.velocities, point.accelerations])
        self._references.append((stamp.sec + stamp.nanosec / _NANOSECONDS, values))

    def _on_target(self, arm: str, message: Any, time: int) -> None:
        self._targets[arm] = time, _pose(message)

    def _on_flags(self, row: int, message: Any, _: int) -> None:
        self._flags[row] = message.data

    def _on_event(self, message: Any, time: int) -> None:
        event = json.loads(message.data)
        self._events.append(
            Event.from_json(event | {"t": (time - self._epoch) / _NANOSECONDS})
        )  # its sender's clock is another

    def _on_hand(self, side: int, message: Any, time: int) -> None:
        sample = np.zeros(len(SAMPLE_FIELDS))
        received = (time - self._epoch) / _NANOSECONDS
        sample[1:4] = side, received, received
        sample[4:11] = _pose(message)
        self._samples.append(sample)

    def _on_tick(self, message: Any, time: int) -> None:
        if np.isnan(self._joints).any() or np.isnan(self._flags[:, 0]).any():
            return  # nothing can be said of it yet
        values = dict(zip(self._fields, message.data.tolist(), strict=True))
        targets = {
            arm: pose
            for row, arm in enumerate(self._arms)
            if self._flags[row, 0] > 0.5 and arm in self._targets
            for received, pose in [self._targets[arm]]
            if time - received <= STREAM_TIMEOUT * _NANOSECONDS
        }
        tick = _Tick(time, values, self._joints.copy(), self._flags.copy(), targets, self._samples, self._events)
        self._samples, self._events = [], []
        self._due.append(tick)

    def _whole_ticks(self) -> Iterable[_Tick]:
        """Those whose reference is there; what came with one whose reference was lost is the next one's."""
        while self._due and self._references:
            tick, (now, reference) = self._due[0], self._references[0]
            if now < tick.values["now"] - _SAME:
                self._references.popleft()
                continue
            self._due.popleft()
            if now > tick.values["now"] + _SAME:
                following = self._due[0] if self._due else None
                samples = following.samples if following else self._samples
                events = following.events if following else self._events
                samples[:0], events[:0] = tick.samples, tick.events
                continue
            self._references.popleft()
            tick.reference = reference
            index = int(tick.values["index"])
            # A controller that was started again begins anew.
            self._number += index - self._last_index if 0 < self._last_index < index else 1
            self._last_index, tick.number = index, self._number
            yield tick

    def _chunk(self, ticks: Sequence[_Tick]) -> RecordedChunk:
        """The rows of some ticks."""
        rows: dict[str, Rows] = {}
        times = np.array([tick.time for tick in ticks])
        numbers = np.array([tick.number for tick in ticks])

        def add(topic: str, at: Sequence[int] | None = None, **columns: Array) -> None:
            named = self._topics.by_name[topic]
            assert named.row is not None
            chosen = np.arange(len(ticks)) if at is None else np.array(at, dtype=int)
            if len(chosen):
                made = named.row.rows(named.channel, len(chosen))
                made["log_time"], made["sequence"] = times[chosen], numbers[chosen]
                for name, values in columns.items():
                    made[name] = values
                rows[topic] = made

        joints, reference = np.array([tick.joints for tick in ticks]), np.array([tick.reference for tick in ticks])
        flags = np.array([tick.flags for tick in ticks])
        add(names.JOINT_STATES, position=joints[:, 0], velocity=joints[:, 1], effort=joints[:, 2])
        add(
            names.REFERENCE,
            positions=reference[:, 0],
            velocities=reference[:, 1],
            accelerations=reference[:, 2],
        )
        for topic in (names.TICK, names.FLAGS, names.GRIPPERS):
            columns = [self._number_of(label, ticks, flags) for label in self._topics.by_name[topic].labels["data"]]
            add(topic, data=np.stack(columns, axis=1))
        tools = tool_poses(reference[:, 0], self._robot)
        for row, arm in enumerate(self._arms):
            add(names.safe_target(arm), position=tools[:, row, :3], quaternion=tools[:, row, 3:])
            asked = [at for at, tick in enumerate(ticks) if arm in tick.targets]
            if asked:
                poses = np.array([ticks[at].targets[arm] for at in asked])
                add(names.target(arm), asked, position=poses[:, :3], quaternion=poses[:, 3:])
        taken = [at for at, tick in enumerate(ticks) for _ in tick.samples]
        if taken:
            samples = np.array([sample for tick in ticks for sample in tick.samples])
            samples[:, 0] = numbers[taken]
            add(names.SAMPLES, taken, data=samples)
        states = [self._state(tick.number, tick.time, tick.events) for tick in ticks if tick.events]
        return RecordedChunk(rows, {names.STATE: states} if states else {})

    def _number_of(self, label: str, ticks: Sequence[_Tick], flags: Array) -> Array:
        """(n,) one number of a loop's arrays; 0 for what no node says."""
        if label == "index":
            return np.array([float(tick.number) for tick in ticks])
        if label in ("now", "state_stamp"):
            return np.array([(tick.time - self._epoch) / _NANOSECONDS for tick in ticks])
        if label in ("following", "connected"):
            return np.ones(len(ticks))
        if label in self._fields:
            return np.array([tick.values[label] for tick in ticks])
        what, _, arm = label.rpartition("_")
        if arm in self._arms:
            row = self._arms.index(arm)
            column = {"opening": _MEASURED, "measured": _MEASURED, "wanted": _WANTED, "commanded": _WANTED}.get(what)
            if column is None and what in ARM_FIELDS:
                column = ARM_FIELDS.index(what)
            if column is not None:
                return np.asarray(flags[:, row, column])
        return np.zeros(len(ticks))

    def _state(self, number: int, time: int, events: Sequence[Event]) -> bytes:
        channel = self._topics.by_name[names.STATE].channel
        return text_record(channel, number, time, json.dumps({"events": [event.as_json() for event in events]}))


def _pose(message: Any) -> Array:
    """(7,) x y z [m] qx qy qz qw of a PoseStamped."""
    p, q = message.pose.position, message.pose.orientation
    return np.array([p.x, p.y, p.z, q.x, q.y, q.z, q.w])
