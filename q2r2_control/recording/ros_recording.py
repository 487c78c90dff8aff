"""Reads a recording of the ROS nodes as if one loop had made it.

Each tick of the controller's node becomes one tick. It has the newest joint states, flags of the arms and targets that
had been received before the tick's message. Its reference is the reference message with the same time as the tick.
"""

from __future__ import annotations

import json
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np

from q2r2_control.config.cell_file import parse_config
from q2r2_control.config.external import ControllerKind
from q2r2_control.config.strict import STREAM_TIMEOUT
from q2r2_control.errors import RecordingError
from q2r2_control.events import Event
from q2r2_control.recording import messages as names
from q2r2_control.recording.about import ROS
from q2r2_control.recording.messages import NANOSECONDS, STORE, Message, pose_of
from q2r2_control.recording.reader import Recording, read_events
from q2r2_control.recording.recorded_reasons import event_of
from q2r2_control.recording.recorded_ticks import cell_and_robot_of, tool_poses
from q2r2_control.recording.tick_chunks import TickChunk
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, Rows, tick_type
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array

# If the times of a reference and a tick differ by this or more, the clock was set between the two [s].
_CLOCK_SET = 0.5
# A reference belongs to a tick if their times differ by at most this, because the times may be rounded differently [s].
_SAME = 1e-6


def open_recording(path: Path) -> Recording:
    """Open a recording of a loop or of the ROS nodes. Raises :class:`RecordingError`, see :class:`Recording`."""
    recording = Recording(path)
    return RosRecording(path) if recording.about.source == ROS else recording


def events_of(path: Path) -> list[Event]:
    """Return all events of a recording, in the order of time.

    Args:
        path: The file, or a folder in which it is the only recording.

    Returns:
        The changes of the arms' states with their reasons, and the operator's marks. Times are since the run began [s].
        A kind of reason that no installed package has is read as :attr:`CommonReason.OTHER`, with its name as the text.

    Raises:
        RecordingError: If the file is no recording or is damaged, or if ROS nodes recorded the arms of another
            controller than the built-in one.
    """
    return read_events(open_recording(path))


class RosRecording(Recording):
    """A recording of the ROS nodes, which is read as ticks.

    :meth:`chunks` raises :class:`RecordingError` if a controller other than ours moved the arms.
    """

    def chunks(self) -> Iterator[TickChunk]:
        config, robot = cell_and_robot_of(self)
        if config.controller is not ControllerKind.BUILTIN:
            raise RecordingError(
                f"{self.file}: recorded with controller: {config.controller}, so there is no reference of the built-in "
                "controller to judge or export; ros2 bag, Foxglove and mcap tools open it"
            )
        ticks = RosTicks(self.about.epoch, robot)
        previous: TickChunk | None = None
        for messages in self.messages(ticks.topics):
            with self._faults():
                chunk = ticks.add_messages((self.topic(one), one) for one in messages)
            if len(chunk.rows):
                if previous is not None:
                    yield previous
                previous = chunk
        if previous is not None and self.closed:  # The file is complete, so its last tick is the run's last tick.
            previous.rows["following"][-1] = 0.0
        yield ticks.rest(previous)

    def _topic_of(self, camera: str) -> str:
        topic = parse_config(self.about.cell, f"{self.file}: its cell").cameras[camera].topic
        if topic is None:  # The camera is a device that the recorder itself reads.
            return super()._topic_of(camera)
        if not names.is_compressed(topic):
            raise RecordingError(
                f"{self.file}: pictures of camera {camera} are sensor_msgs/Image on {topic}; allowed to export: "
                "CompressedImage; --no-pictures leaves them out"
            )
        return topic

    def _time_of(self, picture: Message) -> int:
        # The recorder itself reads the devices and sends their pictures, so ``sent`` is by its own clock. Other senders
        # may have other clocks.
        return picture.sent if self.topic(picture) in self._device_topics else picture.time

    @cached_property
    def _device_topics(self) -> set[str]:
        cameras = parse_config(self.about.cell, f"{self.file}: its cell").device_cameras
        return {topic(camera) for camera in cameras for topic in (names.picture_topic, names.depth_topic)}


@dataclass(slots=True)
class _Tick:
    """A tick of the controller whose reference has not been found yet."""

    time: int  # The Unix time at which the tick's message was received [ns].
    now: float  # The time of the tick by the controller's clock [s].
    row: Rows  # (1,), filled with the numbers that were known when the tick was received.
    samples: list[Array]  # The samples that were received since the last tick, each with the numbers of SAMPLE_FIELDS.
    events: list[Event]  # The events since the last tick.


class RosTicks:
    """Makes ticks from the messages of a set of nodes."""

    def __init__(self, epoch: int, robot: Robot) -> None:
        """Times of ticks are counted from ``epoch`` [ns], which is a time of the clock of the messages."""
        self._robot, self._epoch, self._joint_names = robot, epoch, robot.joint_names
        self._arms = arms = tuple(robot.arms)
        self._fields, self._type = names.tick_fields(arms), tick_type(len(arms), len(robot.joint_names))
        self._types = {topic.name: topic.type for topic in names.ros_topics(arms)}
        self.joints = np.full((3, len(robot.joint_names)), np.nan)  # The newest q, v and tau.
        self._known = np.zeros(len(robot.joint_names), dtype=bool)  # True for joints that were measured.
        self._flags = np.full((len(arms), len(names.ARM_FIELDS)), np.nan)
        self._targets: dict[int, tuple[int, Array]] = {}  # Each arm's target: time of receipt [ns], pose.
        self._samples: list[Array] = []
        self._events: list[Event] = []
        self._due: deque[_Tick] = deque()  # Ticks that wait for their references.
        # References that wait for their ticks: the controller's time [s], and q, v and a (3, joints).
        self._references: deque[tuple[float, Array]] = deque()
        # The index that the controller gave to the newest tick, and the number of this tick in the recording.
        self._last_index, self._number = 0, -1
        self._handlers: dict[str, Callable[[Any, int], None]] = {
            names.JOINT_STATES: self._on_joints,
            names.REFERENCE: self._on_reference,
            names.CONTROLLER_TICK: self._on_tick,
            names.RECORDER_EVENTS: self._on_event,
        }
        for place, arm in enumerate(arms):
            self._handlers[names.target(arm)] = partial(self._on_target, place)
            self._handlers[names.arm_flags(arm)] = partial(self._on_flags, place)
            self._handlers[names.arm_events(arm)] = self._on_event
        for side, hand in enumerate(SIDES):
            self._handlers[names.hand_pose(hand)] = partial(self._on_hand, side)

    @property
    def topics(self) -> frozenset[str]:
        """Return the topics from which ticks are made."""
        return frozenset(self._handlers)

    def add_messages(self, messages: Iterable[tuple[str, Message]]) -> TickChunk:
        """Take messages, each with its topic. Return the ticks that are complete now; there may be none."""
        for topic, message in messages:
            if (handle := self._handlers.get(topic)) is not None:
                handle(STORE.deserialize_cdr(message.payload, self._types[topic]), message.time)
        return self._chunk(list(self._whole_ticks()))

    def rest(self, last: TickChunk | None) -> TickChunk:
        """Return the ``last`` chunk with all later events added to it. If it is None, return a chunk without ticks."""
        chunk = self._chunk([]) if last is None else last
        if events := [*(event for tick in self._due for event in tick.events), *self._events]:
            number = max(self._number, 0)
            before = chunk.events().get(number, [])
            chunk.states[number] = _state([*before, *events])
        return chunk

    def _on_joints(self, message: Any, _: int) -> None:
        columns = {name: column for column, name in enumerate(message.name)}
        ours = [index for index, name in enumerate(self._joint_names) if name in columns]
        places = [columns[self._joint_names[index]] for index in ours]
        self._known[ours] = True
        for row, field in enumerate(("position", "velocity", "effort")):
            numbers = np.asarray(getattr(message, field), dtype=np.float64)
            self.joints[row, ours] = names.measured(field, numbers[places]) if len(numbers) else 0.0

    def _on_reference(self, message: Any, _: int) -> None:
        stamp, point = message.header.stamp, message.points[0]
        values = np.array([point.positions, point.velocities, point.accelerations])
        self._references.append((stamp.sec + stamp.nanosec / NANOSECONDS, values))

    def _on_target(self, place: int, message: Any, time: int) -> None:
        self._targets[place] = time, pose_of(message)

    def _on_flags(self, place: int, message: Any, _: int) -> None:
        self._flags[place] = message.data

    def _on_event(self, message: Any, time: int) -> None:
        # The time of receipt replaces the sender's time, because the sender has another clock.
        told = json.loads(message.data) | {"t": (time - self._epoch) / NANOSECONDS}
        self._events.append(event_of(told))

    def _on_hand(self, side: int, message: Any, time: int) -> None:
        sample = np.zeros(len(SAMPLE_FIELDS))
        received = (time - self._epoch) / NANOSECONDS
        sample[1:4] = side, received, received
        sample[4:11] = pose_of(message)
        self._samples.append(sample)

    def _on_tick(self, message: Any, time: int) -> None:
        if not self._known.all() or np.isnan(self._flags[:, 0]).any():
            return  # The tick cannot be used, since some joints or flags are not known yet.
        values = dict(zip(self._fields, message.data.tolist(), strict=True))
        row = np.zeros(1, dtype=self._type)
        for name in set(values) & set(self._type.names or ()):
            row[name] = values[name]
        row["now"] = row["state_stamp"] = (time - self._epoch) / NANOSECONDS
        row["following"] = row["connected"] = 1.0
        row["q"], row["v"], row["tau"] = self.joints
        arms = row["arms"][0]
        for place, (arm, flags) in enumerate(zip(self._arms, self._flags, strict=True)):
            for name, value in zip(names.ARM_FIELDS, flags.tolist(), strict=True):
                arms["opening" if name == "measured" else name][place] = value
            arms["commanded"][place] = arms["wanted"][place]
            arms["rejected"][place] = values[f"rejected_{arm}"]
            received, pose = self._targets.get(place, (0, None))
            if pose is not None and arms["engaged"][place] > 0.5 and time - received <= STREAM_TIMEOUT * NANOSECONDS:
                arms["target"][place] = pose
        self._due.append(_Tick(time, values["now"], row, self._samples, self._events))
        self._samples, self._events = [], []

    def _whole_ticks(self) -> Iterator[_Tick]:
        """Yield the ticks whose reference has been received.

        A tick whose reference was lost is dropped. Its samples and events go to the next tick.
        """
        while self._due and self._references:
            tick, (now, reference) = self._due[0], self._references[0]
            if self._is_older(now, tick.now):
                self._references.popleft()
                continue
            self._due.popleft()
            if abs(now - tick.now) > _SAME:
                following = self._due[0] if self._due else None
                samples = following.samples if following else self._samples
                events = following.events if following else self._events
                samples[:0], events[:0] = tick.samples, tick.events
                continue
            self._references.popleft()
            row, index = tick.row, int(tick.row["index"][0])
            row["reference_q"], row["reference_v"], row["reference_a"] = reference
            # If the controller was started again, its index begins again and does not show how many ticks are missing.
            self._number += index - self._last_index if 0 < self._last_index < index else 1
            self._last_index = index
            row["index"] = self._number
            yield tick

    def _is_older(self, reference: float, tick: float) -> bool:
        """Return whether the oldest waiting reference is older than the oldest waiting tick, and so belongs to no tick.

        ``reference`` and ``tick`` are the times of these two by the controller's clock [s].
        """
        if abs(reference - tick) < _CLOCK_SET:
            return reference < tick - _SAME
        # The clock was set, forward or back, between the reference and the tick. Their times therefore cannot be
        # compared. The other waiting ticks and references show which of the two is older.
        return not any(abs(other.now - reference) <= _SAME for other in self._due) and any(
            abs(other - tick) <= _SAME for other, _ in self._references
        )

    def _chunk(self, ticks: Sequence[_Tick]) -> TickChunk:
        rows = np.concatenate([np.empty(0, dtype=self._type), *(tick.row for tick in ticks)])
        rows["arms"]["tool"] = tool_poses(rows["reference_q"], self._robot)
        states, samples = {}, [np.empty((0, len(SAMPLE_FIELDS)))]
        for tick, number in zip(ticks, rows["index"].astype(int).tolist(), strict=True):
            for sample in tick.samples:
                sample[0] = number
                samples.append(sample[None])
            if tick.events:
                states[number] = _state(tick.events)
        times = np.array([tick.time for tick in ticks], dtype=np.int64)
        return TickChunk(rows, times, np.concatenate(samples), states)


def _state(events: Sequence[Event]) -> str:
    return json.dumps({"events": [event.as_json() for event in events]})
