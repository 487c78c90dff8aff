"""The process that writes a recording. It imports none of the modules of the control loop."""

from __future__ import annotations

import json
import os
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from queue import SimpleQueue
from threading import Condition, Thread
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.recording import messages
from q2r2_control.recording.about import About, Conclusion
from q2r2_control.recording.bag import BagWriter
from q2r2_control.recording.messages import NANOSECONDS, CodedPicture, Message, MessageTemplate, Topic
from q2r2_control.recording.tick_rows import POSE_FIELDS, SAMPLE_FIELDS, PackedTick, numbers_in, tick_type
from q2r2_control.types import QUEST_CONTROLS, SIDES, Array

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Robot

FLUSH_PERIOD = 0.5  # Time between two flushes of the file [s]. If this process is killed, at most this time is lost.
READ_AHEAD = 4 << 20  # Largest size of the requests that were read from the pipe and wait to be written [bytes].
_NICENESS = 10  # The niceness of this process. With it, the loop has a higher priority.
# Times are rounded, so a tick may seem to come a little before the period of the topics to which it belongs. A tick
# therefore belongs to the next period if that period begins within this share of a period.
_ROUNDING = 1e-6
_LAST_TIME = (2**31 - 1) * NANOSECONDS  # The latest time of a stamp [ns].
_HAND, _POSE_STAMP, _INPUTS_STAMP, _X, _BUTTONS = (
    SAMPLE_FIELDS.index(name) for name in ("hand", "pose_stamp", "inputs_stamp", "x", "button_upper")
)


@dataclass(frozen=True)
class RecordedRobot:
    """The robot's data that messages need. Unlike the robot itself, it can be sent to another process."""

    model: pin.Model
    joints: tuple[str, ...]
    arms: tuple[str, ...]
    tools: tuple[int, ...]  # The id of each arm's tool frame.
    urdf: str

    @classmethod
    def of(cls, robot: Robot) -> RecordedRobot:
        tools = tuple(arm.frame_id for arm in robot.arms.values())
        return cls(robot.model, tuple(robot.joint_names), tuple(robot.arms), tools, robot.urdf)

    def tool_poses(self, postures: Array) -> Array:
        """Return the tool poses (n, arms, 7) x y z [m] qx qy qz qw in the world, at ``postures`` (n, joints)."""
        data = self.model.createData()
        poses = np.empty((len(postures), len(self.tools), len(POSE_FIELDS)))
        for q, row in zip(postures, poses, strict=True):
            pin.forwardKinematics(self.model, data, q)
            for pose, frame in zip(row, self.tools, strict=True):
                pose[:] = pin.SE3ToXYZQUATtuple(pin.updateFramePlacement(self.model, data, frame))
        return poses


class TickEncoder:
    """Makes messages from ticks, in the order of the ticks.

    ``epoch`` [ns] is the Unix time at which the run began.
    """

    def __init__(
        self, robot: RecordedRobot, topics: dict[str, Topic], epoch: int, topic_rate: float | None = None
    ) -> None:
        """``topic_rate`` [Hz] is the rate of the standard topics, which repeat numbers of ticks; None: every tick."""
        self._robot, self._topics, self._epoch, self._topic_rate = robot, topics, epoch, topic_rate
        self._slot = -1.0  # The newest tick is in this period of the standard topics; periods are counted from 0.
        self._type = tick_type(len(robot.arms), len(robot.joints))
        self._start: float | None = None  # The time of the loop's clock at the start of the run [s].
        self._stamps: dict[tuple[float, int], float] = {}  # The stamp of the last sample, for each hand and column.
        self._templates = _templates(list(robot.joints))
        self._poses = {
            frame: MessageTemplate(messages.POSE, messages.pose_stamped(np.arange(1.0, 8.0), frame), 7)
            for frame in ("", messages.WORLD)
        }

    def encode(self, batch: Sequence[PackedTick]) -> list[Message]:
        """Return the messages of the next packed ticks, in the order of the ticks.

        Readers expect this order in a file without an index.
        """
        rows = np.frombuffer(b"".join(tick.row for tick in batch), dtype=self._type).copy()
        rows["arms"]["tool"] = self._robot.tool_poses(rows["reference_q"])
        first = []
        if self._start is None:
            self._start = float(json.loads(batch[0].state)["start"]["now"])
            channel = self._topics[messages.DESCRIPTION].channel
            first.append(Message(channel, 0, self._epoch, self._epoch, messages.text(self._robot.urdf)))
        made = _Batch(self._topics, rows["index"].astype(np.int64), self._times(rows["now"]))
        every, arms = np.arange(len(rows)), rows["arms"]
        some = self._due(rows["now"])
        made.add(messages.TICK, every, [messages.array(numbers) for numbers in numbers_in(rows)])
        for at, tick in enumerate(batch):
            self._add_samples(made, at, np.frombuffer(tick.samples).reshape(-1, len(SAMPLE_FIELDS)))
        felt = some[rows["external"][some] > 0.0]
        external = self._templates[messages.EXTERNAL_TORQUE].filled(rows["tau_external"][felt], made.times[felt])
        made.add(messages.EXTERNAL_TORQUE, felt, external)
        for index, arm in enumerate(self._robot.arms):
            for topic, field, frame in (
                (messages.filtered_hand(arm), "filtered_hand", ""),
                (messages.target(arm), "target", messages.WORLD),
                (messages.safe_target(arm), "tool", messages.WORLD),
            ):
                poses = arms[field][:, index]
                there = some[poses[some].any(axis=1)]
                made.add(topic, there, self._poses[frame].filled(poses[there], made.times[there]))
        for topic, columns in (
            (messages.JOINT_STATES, ("q", "v", "tau")),
            (messages.REFERENCE, ("reference_q", "reference_v", "reference_a")),
            (messages.JOINT_COMMANDS, ("command_q", "command_v", "command_tau")),
        ):
            numbers = np.hstack([rows[name][some] for name in columns])
            made.add(topic, some, self._templates[topic].filled(numbers, made.times[some]))
        told = [at for at, tick in enumerate(batch) if tick.state]
        made.add(messages.STATE, told, [messages.text(batch[at].state) for at in told])
        return first + [message for of_tick in made.messages for message in of_tick]

    def _due(self, now: Array) -> npt.NDArray[np.int64]:
        """Return the indices of the ticks that get messages on the standard topics.

        In each period of the topics, the first tick gets messages. The ticks have the times ``now`` (n,) [s].
        """
        if self._topic_rate is None:
            return np.arange(len(now))
        assert self._start is not None
        slots = np.floor(np.nan_to_num(now - self._start) * self._topic_rate + _ROUNDING)
        newest = np.maximum.accumulate(np.concatenate(([self._slot], slots)))
        self._slot = float(newest[-1])
        return np.flatnonzero(np.diff(newest) > 0.0)

    def _times(self, seconds: Array) -> npt.NDArray[np.int64]:
        """Convert times of the loop's clock [s] to Unix times [ns].

        NaN becomes the start of the run. Times that do not fit into a stamp become the nearest time that fits.
        """
        assert self._start is not None
        passed = np.clip(np.nan_to_num(seconds - self._start) * NANOSECONDS, -_LAST_TIME, _LAST_TIME)
        return np.clip(np.rint(passed).astype(np.int64) + self._epoch, 0, _LAST_TIME)

    def _add_samples(self, made: _Batch, at: int, samples: Array) -> None:
        """Add messages with the samples of a tick as the loop got them.

        If the pose or the inputs of a sample are new, also add a ROS message with the pose or the inputs.
        """
        for sample in samples:
            hand = SIDES[int(sample[_HAND])]
            made.add(messages.SAMPLES, [at], [messages.array(sample)])
            if self._is_new(sample, _POSE_STAMP):
                (stamp,) = self._times(sample[_POSE_STAMP : _POSE_STAMP + 1]).tolist()
                pose = messages.pose_stamped(sample[_X : _X + len(POSE_FIELDS)], stamp=stamp)
                made.add(messages.hand_pose(hand), [at], [messages.serialized(messages.POSE, pose)])
            if self._is_new(sample, _INPUTS_STAMP):
                with np.errstate(over="ignore"):  # A device may send numbers that are too large for float32.
                    values = sample[_BUTTONS : _BUTTONS + len(QUEST_CONTROLS.names)].astype(np.float32)
                upper, lower, *analog = values.tolist()
                inputs = messages.make(messages.HAND_INPUTS, bool(upper), bool(lower), *analog)
                made.add(messages.hand_buttons(hand), [at], [messages.serialized(messages.HAND_INPUTS, inputs)])

    def _is_new(self, sample: Array, stamp: int) -> bool:
        """Return whether a sample and the sample before it of the same hand differ in the column ``stamp``."""
        before = self._stamps.get((sample[_HAND], stamp))
        self._stamps[sample[_HAND], stamp] = sample[stamp]
        return bool(before != sample[stamp])


class _Batch:
    """The messages of successive ticks. ``numbers`` and ``times`` are the ticks' numbers and Unix times [ns]."""

    def __init__(self, topics: dict[str, Topic], numbers: npt.NDArray[np.int64], times: npt.NDArray[np.int64]) -> None:
        self._topics, self._numbers, self.times = topics, numbers.tolist(), times
        self.messages: list[list[Message]] = [[] for _ in self._numbers]  # One list for each tick.

    def add(self, topic: str, at: Iterable[int], payloads: Iterable[bytes]) -> None:
        channel = self._topics[topic].channel
        for place, payload in zip(at, payloads, strict=True):
            time = int(self.times[place])
            self.messages[place].append(Message(channel, self._numbers[place], time, time, payload))


def _templates(joints: list[str]) -> dict[str, MessageTemplate]:
    n, none = len(joints), np.empty(0)
    q, v, a = np.arange(1.0, 3 * n + 1.0).reshape(3, n)
    states = MessageTemplate(messages.JOINTS, messages.joint_state(joints, q, v, a), 3 * n)
    return {
        messages.JOINT_STATES: states,
        messages.JOINT_COMMANDS: states,
        messages.EXTERNAL_TORQUE: MessageTemplate(messages.JOINTS, messages.joint_state(joints, none, none, q), n),
        messages.REFERENCE: MessageTemplate(messages.TRAJECTORY, messages.joint_trajectory(joints, q, v, a), 3 * n),
    }


@dataclass(frozen=True)
class RecordingSetup:
    """The first request to the writer's process, with the data that the process needs to begin a file."""

    path: Path  # The path of the file, in a folder that exists.
    about: About
    topics: tuple[Topic, ...]  # The topics of the file.
    robot: RecordedRobot | None = None  # The robot, which is needed for packed ticks; None if only messages are sent.
    # The rate of the standard topics, which repeat numbers of ticks [Hz]; None for every tick.
    topic_rate: float | None = None


class Written(NamedTuple):
    """An answer of the writer's process: how many ticks and messages are in the file so far."""

    ticks: int = 0
    messages: int = 0  # The number of messages and pictures that were sent singly, and not within ticks.


def read_ahead(requests: Iterator[Any], room: int = READ_AHEAD) -> Iterator[Any]:
    """Yield the requests. A thread reads them as soon as they come, even while an earlier request is being written.

    If the run is killed, all requests that were read are still written. The thread stops reading while requests of more
    than about ``room`` [bytes] wait.
    """
    waiting: SimpleQueue[tuple[Any, int]] = SimpleQueue()
    free = Condition()
    held, end = 0, object()

    def take() -> None:
        nonlocal held
        for request in requests:
            size = sum(one.size for one in request) if isinstance(request, list) else 0
            with free:
                while held >= room:
                    free.wait()
                held += size
            waiting.put((request, size))
        waiting.put((end, 0))

    Thread(target=take, daemon=True).start()
    while (entry := waiting.get())[0] is not end:
        yield entry[0]
        with free:
            held -= entry[1]
            free.notify()


def main(requests: Iterator[Any], answer: Callable[[Written], None]) -> None:
    """Write one recording.

    The requests are a :class:`RecordingSetup`, lists of packed ticks or of messages, and a :class:`Conclusion`. Raises
    :class:`OSError`; the file then keeps the data that was written before.
    """
    requests = read_ahead(requests)
    setup = next((request for request in requests if request is not None), None)
    if not isinstance(setup, RecordingSetup):
        return  # The recorder ended before a run began.
    about = setup.about
    if about.realtime:  # In simulated time the loop may wait for this process, so its priority is not reduced.
        with suppress(OSError):
            os.nice(_NICENESS)
    encoder = None
    if setup.robot is not None:
        encoder = TickEncoder(setup.robot, about.topics(), about.epoch, setup.topic_rate)
    received, conclusion = Written(), Conclusion()
    due = time.monotonic() + FLUSH_PERIOD
    with BagWriter(setup.path, setup.topics, about) as bag:
        for request in requests:
            if isinstance(request, Conclusion):
                conclusion = request
            elif request and isinstance(request[0], Message | CodedPicture):
                bag.write(one.message() if isinstance(one, CodedPicture) else one for one in request)
                received = received._replace(messages=received.messages + len(request))
            elif request and encoder is not None:
                bag.write(encoder.encode(request))
                received = received._replace(ticks=received.ticks + len(request))
            if time.monotonic() >= due:
                bag.flush()
                answer(received)
                due = time.monotonic() + FLUSH_PERIOD
        bag.close(conclusion)
    answer(received)
