"""From packed ticks to messages, some dozens at a time: the same for a recording and for what a replay is held to."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from operator import itemgetter
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.recording import topics as names
from q2r2_control.recording.packing import POSE, unpack
from q2r2_control.recording.rows import Rows, text_record
from q2r2_control.recording.topics import SAMPLE_FIELDS, Topic, Topics
from q2r2_control.types import SIDES, Array, HandInputs

if TYPE_CHECKING:
    from q2r2_control.robot.robot import Robot

_NANOSECONDS = 1_000_000_000
_LAST_TIME = 2**62
_HAND, _POSE_STAMP, _INPUTS_STAMP, _X = (
    SAMPLE_FIELDS.index(name) for name in ("hand", "pose_stamp", "inputs_stamp", "x")
)


@dataclass(frozen=True)
class RecordedRobot:
    """What messages need of a robot; unlike the robot itself it can be sent to another process."""

    model: pin.Model
    tools: tuple[int, ...]  # frames, arm by arm
    urdf: str

    @classmethod
    def of(cls, robot: Robot) -> RecordedRobot:
        return cls(robot.model, tuple(arm.frame_id for arm in robot.arms.values()), robot.urdf)


@dataclass(frozen=True, slots=True)
class Block:
    """Messages of one topic: records of rows or texts, and the place of each one's tick in the batch."""

    topic: Topic
    at: Sequence[int]
    rows: Rows | None
    texts: Sequence[bytes] = ()

    def records(self) -> list[bytes]:
        """Each message's whole record."""
        if self.rows is None:
            return list(self.texts)
        size, data = self.rows.dtype.itemsize, self.rows.tobytes()
        return [data[start : start + size] for start in range(0, len(data), size)]


class TickEncoder:
    """Makes messages of ticks, in their order. ``epoch`` [ns] is the time of day at which the run began."""

    def __init__(self, robot: RecordedRobot, topics: Topics, epoch: int) -> None:
        self.topics = topics
        self._robot, self._model_data = robot, robot.model.createData()
        self._epoch, self._start = epoch, 0.0
        self._stamps: dict[tuple[str, int], float] = {}  # the last of each hand's poses and inputs

    def encode(self, batch: Sequence[bytes]) -> list[Block]:
        """Messages of packed ticks that follow the last ones, topic by topic."""
        ticks, samples, start, states = unpack(batch, self.topics)
        blocks = self._beginning(start) if start else []
        numbers = self._column(ticks, "index").astype(np.int64)
        times = self._times(self._column(ticks, "now"))

        def add(topic: str, at: npt.NDArray[np.intp], stamps: Array | None = None, **columns: Array) -> None:
            if len(at):
                named = self.topics.by_name[topic]
                assert named.row is not None
                rows = named.row.rows(named.channel, len(at))
                rows["log_time"] = rows["publish_time"] = times[at]
                rows["sequence"] = numbers[at]
                if rows.dtype.names and "sec" in rows.dtype.names:
                    stamped = times[at] if stamps is None else self._times(stamps)
                    rows["sec"], rows["nanosec"] = stamped // _NANOSECONDS, stamped % _NANOSECONDS
                for column, values in columns.items():
                    rows[column] = values
                blocks.append(Block(named, at.tolist(), rows))

        every = np.arange(len(ticks))
        add(names.TICK, every, data=ticks[names.TICK])
        self._add_samples(add, samples, self._column(ticks, "samples").astype(np.int64))
        add(names.JOINT_STATES, every, position=ticks["q"], velocity=ticks["v"], effort=ticks["tau"])
        felt = np.flatnonzero(self._column(ticks, "external"))
        add(names.EXTERNAL_TORQUE, felt, effort=ticks["tau_external"][felt])
        tools = self._tools(ticks["reference_q"])
        for index, arm in enumerate(self.topics.arms):
            hands = ticks["filtered_hands"][:, index]
            moved = np.flatnonzero(hands.any(axis=1))
            add(names.filtered_hand(arm), moved, **_pose_columns(hands[moved]))
            led = np.flatnonzero(ticks["led"][:, index])
            add(names.target(arm), led, **_pose_columns(ticks["targets"][led, index]))
            add(names.safe_target(arm), every, **_pose_columns(tools[:, index]))
        add(
            names.REFERENCE,
            every,
            positions=ticks["reference_q"],
            velocities=ticks["reference_v"],
            accelerations=ticks["reference_a"],
        )
        add(
            names.JOINT_COMMANDS,
            every,
            position=ticks["command_q"],
            velocity=ticks["command_v"],
            effort=ticks["command_tau"],
        )
        add(names.GRIPPERS, every, data=ticks[names.GRIPPERS])
        add(names.FLAGS, every, data=ticks[names.FLAGS])
        state = self.topics.by_name[names.STATE]
        told = [at for at, text in enumerate(states) if text]
        if told:
            texts = [text_record(state.channel, int(numbers[at]), int(times[at]), states[at]) for at in told]
            blocks.append(Block(state, told, None, texts))
        return blocks

    def _column(self, ticks: Rows, name: str) -> Array:
        """One number of the topic tick, of every tick."""
        return ticks[names.TICK][:, self.topics.by_name[names.TICK].labels["data"].index(name)]

    def _times(self, seconds: Array) -> Array:
        """Times of the loop's clock [s] as times of day [ns]; any number of a sender gives some time."""
        passed = np.nan_to_num(seconds - self._start) * 1e9
        return np.clip(np.rint(np.clip(passed, -_LAST_TIME, _LAST_TIME)).astype(np.int64) + self._epoch, 0, _LAST_TIME)

    def _beginning(self, start: bytes) -> list[Block]:
        """What is written once: where the run began, and the robot for viewers."""
        topic, description = self.topics.by_name[names.START], self.topics.by_name[names.DESCRIPTION]
        assert topic.row is not None
        rows = topic.row.rows(topic.channel, 1)
        rows["log_time"] = rows["publish_time"] = self._epoch
        rows["data"] = np.frombuffer(start)
        self._start = float(rows["data"][0, 0])
        text = text_record(description.channel, 0, self._epoch, self._robot.urdf)
        return [Block(description, [0], None, [text]), Block(topic, [0], rows)]

    def _add_samples(self, add: Callable[..., None], samples: Array, counts: npt.NDArray[np.int64]) -> None:
        """Samples as the loop got them, and those poses and inputs that are new, as messages of the nodes.

        ``counts``: how many of them each tick has.
        """
        at = np.repeat(np.arange(len(counts)), counts)
        add(names.SAMPLES, at, data=samples)
        for number, hand in enumerate(SIDES):
            of_hand = np.flatnonzero(samples[:, _HAND] == number)
            poses = of_hand[self._changes(hand, _POSE_STAMP, samples[of_hand])]
            add(
                names.hand_pose(hand),
                at[poses],
                stamps=samples[poses, _POSE_STAMP],
                **_pose_columns(samples[poses, _X : _X + POSE]),
            )
            inputs = of_hand[self._changes(hand, _INPUTS_STAMP, samples[of_hand])]
            columns = {name: samples[inputs, SAMPLE_FIELDS.index(name)] for name in HandInputs.__slots__}
            add(names.hand_buttons(hand), at[inputs], **columns)

    def _changes(self, hand: str, stamp: int, samples: Array) -> Array:
        """Which samples of a hand have another stamp than the one before."""
        stamps = samples[:, stamp]
        before = np.concatenate(([self._stamps.get((hand, stamp), math.nan)], stamps))
        self._stamps[hand, stamp] = before[-1]
        return stamps != before[:-1]

    def _tools(self, postures: Array) -> Array:
        """Tool poses (ticks, arms, 7)."""
        robot, data = self._robot, self._model_data
        poses = np.empty((len(postures), len(robot.tools), POSE))
        for row, q in zip(poses, postures, strict=True):
            pin.forwardKinematics(robot.model, data, q)
            for pose, frame in zip(row, robot.tools, strict=True):
                pose[:] = pin.SE3ToXYZQUATtuple(pin.updateFramePlacement(robot.model, data, frame))
        return poses


def _pose_columns(poses: Array) -> dict[str, Array]:
    return {"position": poses[:, :3], "quaternion": poses[:, 3:]}


def in_order(blocks: Iterable[Block]) -> list[bytes]:
    """The records of all messages of a batch, tick by tick, since readers without an index expect that order."""
    placed = [(at, record) for block in blocks for at, record in zip(block.at, block.records(), strict=True)]
    placed.sort(key=itemgetter(0))
    return [record for _, record in placed]
