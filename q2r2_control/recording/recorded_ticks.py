"""The ticks of a recording, with all inputs of each tick."""

from __future__ import annotations

import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache

import numpy as np

from q2r2_control.config.cell import Config
from q2r2_control.config.cell_file import parse_config
from q2r2_control.errors import Q2R2Error, RecordingError
from q2r2_control.events import Event
from q2r2_control.recording.reader import NO_END, Recording
from q2r2_control.recording.recorded_reasons import chunk_of
from q2r2_control.recording.tick_chunks import TickChunk
from q2r2_control.recording.tick_rows import HAND_FAULTS, NOT_MEASURED, SAMPLE_FIELDS, PackedTick
from q2r2_control.recording.writer import RecordedRobot
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import RunStart
from q2r2_control.types import QUEST_CONTROLS, SIDES, ActionChunk, Array, HandInputs, HandSample, RobotState

_SAME_POSE = 1e-6  # Two poses are equal if each number of their positions [m] and quaternions differs by at most this.


@dataclass(frozen=True, slots=True)
class RecordedTick:
    """One tick of a recording, with all data that the loop received in this tick."""

    number: int
    now: float
    dt: float
    following: bool
    connected: bool
    samples: list[HandSample]
    chunks: list[ActionChunk]
    state: RobotState
    openings: dict[str, float]
    unsolved: int
    events: list[Event]
    packed: PackedTick  # The whole tick as it was recorded.


class RecordedTicks:
    """Reads the ticks of a recording, one after the other, up to the first tick that is missing."""

    def __init__(self, recording: Recording) -> None:
        self._arms = recording.about.arms
        self._ticks = self._all(recording)
        self._starts: list[RunStart] = []
        self.missing = 0  # The number of ticks that are missing just after the last tick that can be read.
        self.current: RecordedTick | None = None
        self.next = next(self._ticks, None)
        if self.next is None or not self._starts:
            why = "" if recording.closed else f"; {NO_END}"
            raise RecordingError(f"{recording.file}: no tick was recorded{why}")
        self.start = self._starts[0]

    def advance(self) -> RecordedTick:
        """Make the next tick the current tick, and return it. Raises :class:`NoMoreTicksError` after the last tick."""
        if self.next is None:
            raise NoMoreTicksError
        self.current, self.next = self.next, next(self._ticks, None)
        return self.current

    def _all(self, recording: Recording) -> Iterator[RecordedTick]:
        expected = 0
        for chunk in recording.chunks():
            try:
                ticks = list(self._ticks_of(chunk))
            except (ValueError, KeyError, TypeError) as error:
                raise RecordingError(f"{recording.file}: damaged: {error!r:.200}") from error
            for tick in ticks:
                if tick.number != expected:
                    self.missing = tick.number - expected
                    return
                yield tick
                expected += 1

    def _ticks_of(self, chunk: TickChunk) -> Iterator[RecordedTick]:
        events = chunk.events()
        places = np.searchsorted(chunk.samples[:, 0], [chunk.numbers, chunk.numbers + 1])
        for row, number, first, end in zip(chunk.rows, chunk.numbers.tolist(), *places.tolist(), strict=True):
            state = chunk.states.get(number, "")
            if not self._starts and state:
                start = json.loads(state)["start"]
                numbers = {name: np.array(start[name], dtype=np.float64) for name in ("q", "v", "tau")}
                felt = None if start["tau_external"] is None else np.array(start["tau_external"], dtype=np.float64)
                at_start = RobotState(**numbers, tau_external=felt, stamp=start["stamp"])
                self._starts.append(RunStart(start["now"], at_start))
            samples, openings = chunk.samples[first:end], row["arms"]["opening"].tolist()
            text = json.loads(state) if state else {}
            more = text.get("more_inputs", [{}] * len(samples))
            external = row["tau_external"].copy() if row["external"] else None
            yield RecordedTick(
                number=number,
                now=float(row["now"]),
                dt=float(row["dt"]),
                following=bool(row["following"]),
                connected=bool(row["connected"]),
                samples=list(map(_sample, samples, more)),
                chunks=[chunk_of(data) for data in text.get("chunks", [])],
                state=RobotState(
                    row["q"].copy(), row["v"].copy(), row["tau"].copy(), external, float(row["state_stamp"])
                ),
                openings={
                    arm: opening for arm, opening in zip(self._arms, openings, strict=True) if opening != NOT_MEASURED
                },
                unsolved=int(row["unsolved"]),
                events=events.get(number, []),
                packed=PackedTick(row.tobytes(), samples.tobytes(), state),
            )


class NoMoreTicksError(Exception):
    """There are no more ticks: the run ended or was killed, or ticks were lost."""


def _sample(numbers: Array, more: dict[str, float]) -> HandSample:
    values = dict(zip(SAMPLE_FIELDS, numbers.tolist(), strict=True))
    inputs = {name: values[name] for name in QUEST_CONTROLS.names}
    for button in QUEST_CONTROLS.buttons:
        inputs[button] = bool(inputs[button])
    return HandSample(
        hand=SIDES[int(values["hand"])],
        position=numbers[4:7].copy(),
        quaternion=numbers[7:11].copy(),
        pose_stamp=values["pose_stamp"],
        inputs=HandInputs(**inputs, more=more),
        inputs_stamp=values["inputs_stamp"],
        fault=HAND_FAULTS[int(values["fault"])],
    )


def cell_and_robot_of(recording: Recording, config: Config | None = None) -> tuple[Config, Robot]:
    """Return the recorded cell and its robot, or ``config`` and its robot if ``config`` is given.

    Raises :class:`RecordingError` if the recorded cell cannot be built, or if the cell has other arms or joints than
    the recording.
    """
    about = recording.about
    if config is not None:
        cell, robot = config, Robot.from_config(config)
    else:
        try:
            cell, robot = _built(about.cell)
        except Q2R2Error as error:
            raise RecordingError(f"{recording.file}: {error}") from error
    if tuple(robot.arms) != about.arms or tuple(robot.joint_names) != about.joints:
        raise RecordingError(f"{recording.file}: recorded with other arms or joints than {cell.name} has")
    return cell, robot


@lru_cache(maxsize=4)
def _built(text: str) -> tuple[Config, Robot]:
    config = parse_config(text, "its cell")
    return config, Robot.from_config(config)


def check_tools(positions: Array, tools: Array, robot: Robot) -> None:
    """Check that a robot is the recorded robot.

    Raises :class:`RecordingError` if its tool poses at ``positions`` (joints,) differ from the recorded poses ``tools``
    (arms, 7), x y z [m] qx qy qz qw in the world.
    """
    (found,) = tool_poses(positions[None], robot)
    # A quaternion and its negative are the same rotation, so the nearer one of both is compared.
    near = np.minimum(np.abs(found - tools), np.abs(found + tools))[:, 3:].max() < _SAME_POSE
    if not near or np.abs(found - tools)[:, :3].max() > _SAME_POSE:
        raise RecordingError("the robot that its cell names now is not the recorded one: tools are elsewhere")


def tool_poses(positions: Array, robot: Robot) -> Array:
    """Return the poses (n, arms, 7) x y z [m] qx qy qz qw of the tools in the world, at joint positions (n, joints)."""
    return RecordedRobot.of(robot).tool_poses(positions)
