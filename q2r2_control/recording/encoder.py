"""From ticks to messages, some dozens of ticks at a time: the same for a recording and for what a replay is held to."""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.recording import topics as names
from q2r2_control.recording.rows import Rows, text_record
from q2r2_control.recording.topics import Topic, Topics
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.recorder import Tick
from q2r2_control.types import SIDES, Array, CommandMode, HandInputs, HandSample, RobotState, StepStatus

NOT_MEASURED = -math.inf  # in place of the opening of a gripper that the plant does not measure
COMMAND_MODES, STATUSES = tuple(CommandMode), tuple(StepStatus)
UNSOLVED_MAX = 2**53  # more substeps than a float64 has bits for cannot be told apart
_NANOSECONDS = 1_000_000_000
_LAST_TIME = 2**62

NumberedTick = tuple[int, Tick]  # with its number, from 0 on


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

    def __init__(self, robot: Robot, topics: Topics, epoch: int) -> None:
        self.topics = topics
        self._robot, self._arms, self._joints = robot, tuple(robot.arms), len(robot.joint_names)
        self._model_data = robot.model.createData()
        self._epoch = epoch
        self._started = False
        self._state = ""  # the last text
        self._stamps = dict.fromkeys(SIDES, (math.nan, math.nan))  # of the last pose and inputs written

    def encode(self, batch: Sequence[NumberedTick]) -> list[Block]:
        """Messages of a batch that follows the last one, topic by topic."""
        ticks = [tick for _, tick in batch]
        numbers = [number for number, _ in batch]
        every = range(len(batch))
        start = ticks[0].start.now
        times = self._times((tick.now for tick in ticks), start)
        blocks = self._beginning(ticks[0]) if not self._started else []
        self._started = True

        def add(topic: str, at: Sequence[int], stamps: Any = None, **columns: Any) -> None:
            if len(at):
                place = np.array(at)
                row = self.topics.by_name[topic]
                assert row.row is not None
                rows = row.row.rows(row.channel, len(at))
                rows["log_time"] = rows["publish_time"] = times[place]
                rows["sequence"] = np.array(numbers)[place]
                if rows.dtype.names and "sec" in rows.dtype.names:
                    stamped = times[place] if stamps is None else stamps
                    rows["sec"], rows["nanosec"] = stamped // _NANOSECONDS, stamped % _NANOSECONDS
                for column, values in columns.items():
                    rows[column] = values
                blocks.append(Block(row, at, rows))

        add(names.TICK, every, data=[self._tick(number, tick) for number, tick in batch])
        self._add_samples(add, batch, start)
        states = [tick.state for tick in ticks]
        add(
            names.JOINT_STATES,
            every,
            position=[state.q for state in states],
            velocity=[state.v for state in states],
            effort=[state.tau for state in states],
        )
        felt = [i for i in every if states[i].tau_external is not None]
        add(names.EXTERNAL_TORQUE, felt, effort=[states[i].tau_external for i in felt])
        tools = [self._tools(tick.reference.q) for tick in ticks]
        for index, arm in enumerate(self._arms):
            led = [i for i in every if ticks[i].targets[arm].pose is not None]
            poses = [pin.SE3ToXYZQUATtuple(ticks[i].targets[arm].pose) for i in led]
            add(names.target(arm), led, **_pose_columns(poses))
            add(names.safe_target(arm), every, **_pose_columns([tool[index] for tool in tools]))
        references = [tick.reference for tick in ticks]
        add(
            names.REFERENCE,
            every,
            positions=[reference.q for reference in references],
            velocities=[reference.v for reference in references],
            accelerations=[reference.a for reference in references],
        )
        commands = [tick.command for tick in ticks]
        add(
            names.JOINT_COMMANDS,
            every,
            position=[command.q for command in commands],
            velocity=[command.v for command in commands],
            effort=[command.tau for command in commands],
        )
        add(names.GRIPPERS, every, data=[self._grippers(tick) for tick in ticks])
        add(names.FLAGS, every, data=[self._flags(tick) for tick in ticks])
        self._add_states(blocks, batch, times)
        return blocks

    def _times(self, seconds: Iterable[float], start: float) -> Any:
        """Times of the loop's clock [s] as times of day [ns]; any number of a sender gives some time."""
        passed = np.nan_to_num(np.array(list(seconds), dtype=np.float64) - start) * 1e9
        return np.clip(np.rint(np.clip(passed, -_LAST_TIME, _LAST_TIME)).astype(np.int64) + self._epoch, 0, _LAST_TIME)

    def _beginning(self, tick: Tick) -> list[Block]:
        """What is written once: where the run began, and the robot for viewers."""
        start = tick.start
        topic = self.topics.by_name[names.START]
        assert topic.row is not None
        rows = topic.row.rows(topic.channel, 1)
        rows["log_time"] = rows["publish_time"] = self._epoch
        rows["data"] = [start.now, start.state.stamp, start.state.tau_external is not None, *_joints(start.state)]
        description = self.topics.by_name[names.DESCRIPTION]
        text = text_record(description.channel, 0, self._epoch, self._robot.urdf)
        return [Block(description, [0], None, [text]), Block(topic, [0], rows)]

    def _tick(self, number: int, tick: Tick) -> list[float]:
        report = tick.reference.report
        return [
            number,
            tick.now,
            tick.dt,
            tick.step,
            tick.state.stamp,
            tick.following,
            tick.connected,
            sum(sample.hand in SIDES for sample in tick.samples),
            tick.state.tau_external is not None,
            min(report.unsolved, UNSOLVED_MAX),
            COMMAND_MODES.index(tick.command.mode),
            *(tick.openings.get(arm, NOT_MEASURED) for arm in self._arms),
            tick.compute_time,
            report.solve_time,
        ]

    def _add_samples(self, add: Callable[..., None], batch: Sequence[NumberedTick], start: float) -> None:
        """Samples as the loop got them, and those poses and inputs that are new, as messages of the nodes."""
        samples = [
            (at, number, sample)
            for at, (number, tick) in enumerate(batch)
            for sample in tick.samples
            if sample.hand in SIDES
        ]
        add(
            names.SAMPLES,
            [at for at, _, _ in samples],
            data=[_sample_row(number, sample) for _, number, sample in samples],
        )
        for hand in SIDES:
            poses, inputs = [], []
            for at, _, sample in samples:
                if sample.hand == hand:
                    pose_stamp, inputs_stamp = self._stamps[hand]
                    if sample.pose_stamp != pose_stamp:
                        poses.append((at, sample))
                    if sample.inputs_stamp != inputs_stamp:
                        inputs.append((at, sample))
                    self._stamps[hand] = sample.pose_stamp, sample.inputs_stamp
            add(
                names.hand_pose(hand),
                [at for at, _ in poses],
                stamps=self._times((sample.pose_stamp for _, sample in poses), start),
                position=[sample.position for _, sample in poses],
                quaternion=[sample.quaternion for _, sample in poses],
            )
            values = {name: [getattr(sample.inputs, name) for _, sample in inputs] for name in HandInputs.__slots__}
            add(names.hand_buttons(hand), [at for at, _ in inputs], **values)

    def _tools(self, q: Array) -> list[tuple[float, ...]]:
        model, data = self._robot.model, self._model_data
        pin.forwardKinematics(model, data, q)
        return [
            pin.SE3ToXYZQUATtuple(pin.updateFramePlacement(model, data, arm.frame_id))
            for arm in self._robot.arms.values()
        ]

    def _grippers(self, tick: Tick) -> list[float]:
        commanded, measured = tick.command.grippers, tick.openings
        return [
            value
            for arm in self._arms
            for value in (
                tick.targets[arm].gripper,
                commanded.get(arm, NOT_MEASURED),
                measured.get(arm, NOT_MEASURED),
            )
        ]

    def _flags(self, tick: Tick) -> list[float]:
        report = tick.reference.report
        flags = [
            STATUSES.index(report.status),
            report.certified,
            report.fallback,
            report.closest_distance,
            report.margin,
            report.slack,
        ]
        for arm in self._arms:
            wanted = tick.targets[arm]
            held, holding = arm in tick.held_grippers, tick.holding.get(arm, False)
            flags += [tick.engaged[arm], arm in report.rejected, wanted.slip, wanted.slip_angle, held, holding]
        return flags

    def _add_states(self, blocks: list[Block], batch: Sequence[NumberedTick], times: Any) -> None:
        """What has names, as JSON, at the ticks at which it changed."""
        topic, at, texts = self.topics.by_name[names.STATE], [], []
        for index, (number, tick) in enumerate(batch):
            report = tick.reference.report
            state: dict[str, Any] = {
                "states": tick.states,
                "connected": tick.connected,
                "status": report.status,
                "closest_pair": report.closest_pair,
                "tightest_pair": report.tightest_pair,
                "held_grippers": tick.held_grippers,
                "holding": tick.holding,
            }
            text = json.dumps(state)
            if text == self._state and not tick.events:
                continue
            self._state = text
            if tick.events:
                text = json.dumps({**state, "events": [asdict(event) for event in tick.events]})
            at.append(index)
            texts.append(text_record(topic.channel, number, int(times[index]), text))
        if texts:
            blocks.append(Block(topic, at, None, texts))


def _joints(state: RobotState) -> list[float]:
    """Positions, velocities, torques and external torques, zero where the plant cannot tell those."""
    external = np.zeros(len(state.q)) if state.tau_external is None else state.tau_external
    return [*state.q, *state.v, *state.tau, *external]


def _sample_row(number: int, sample: HandSample) -> list[float]:
    inputs = (getattr(sample.inputs, name) for name in HandInputs.__slots__)
    stamps = (sample.pose_stamp, sample.inputs_stamp)
    return [number, SIDES.index(sample.hand), *stamps, *sample.position, *sample.quaternion, *inputs]


def _pose_columns(poses: Sequence[tuple[float, ...]]) -> dict[str, Any]:
    return {"position": [pose[:3] for pose in poses], "quaternion": [pose[3:] for pose in poses]}


def in_order(blocks: Iterable[Block]) -> list[tuple[Topic, bytes]]:
    """All messages of a batch, tick by tick, since readers without an index expect them in order of time."""
    placed = [
        (at, block.topic, record) for block in blocks for at, record in zip(block.at, block.records(), strict=True)
    ]
    placed.sort(key=lambda message: message[0])
    return [(topic, record) for _, topic, record in placed]
