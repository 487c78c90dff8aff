"""A recording as arrays: what is needed of every tick, and poses some hundred times a second."""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import Any, TypeVar

import numpy as np
import numpy.typing as npt

from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import Stance
from q2r2_control.errors import RecordingError
from q2r2_control.events import Event
from q2r2_control.recording import topics as names
from q2r2_control.recording.about import Conclusion
from q2r2_control.recording.episode_spans import events_of
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_robot import cell_and_robot_of, check_tools, tool_poses
from q2r2_control.recording.ticks import ChunkTicks, Column, ticks_of
from q2r2_control.types import SIDES, Array

FRAME = 0.01  # the time between two frames, at least [s]
_NANOSECONDS = 1_000_000_000

Flags = npt.NDArray[np.bool_]


@dataclass(frozen=True)
class Ticks:
    """One row for each of n ticks that are in the file."""

    number: npt.NDArray[np.int64]  # (n,) from 0 on; those that were lost are left out
    t: Array  # (n,) since the run began [s]
    dt: Array  # (n,) since the loop's last tick, whether that is in the file or not [s]
    compute_time: Array  # (n,) [s]
    following: Flags  # (n,) False: the run ends, and the arms come to rest
    certified: Flags  # (n,) a certified stop is known
    fallback: Flags  # (n,) it was executed
    distance: Array  # (n,) of the nearest pair [m]
    margin: Array  # (n,) of the tightest pair, less the distance that it keeps [m]
    engaged: Flags  # (n, arms)
    rejected: Flags  # (n, arms) the target was not usable
    slip: Array  # (n, arms) how far the leash has dragged the target since engaging [m]
    slip_angle: Array  # (n, arms) [rad]
    gripper: Array  # (n, arms) opening that is wanted, 0 closed .. 1 open


@dataclass(frozen=True)
class Frames:
    """One row for each of m ticks that are :data:`FRAME` apart. Poses are x y z [m] qx qy qz qw in the world."""

    at: npt.NDArray[np.int64]  # (m,) rows of the ticks
    q: Array  # (m, joints) measured [rad]
    target: Array  # (m, arms, 7) of the operator; where there is none, the tool at the reference
    reference: Array  # (m, arms, 7) tools at the controller's reference


@dataclass(frozen=True)
class Hand:
    """What came of one hand: k samples, whose poses need not be numbers."""

    arm: str  # that it leads
    received: Array  # (k,) receipt of the pose [s]
    polled: Array  # (k,) time of the tick that took it [s]
    position: Array  # (k, 3) in the input's frame [m]


@dataclass(frozen=True)
class Episode:
    """One recording, or an episode in it. Times are since it began."""

    recording: Recording
    config: Config
    ticks: Ticks
    frames: Frames
    tools: Array  # (m, arms, 7) measured, at the frames
    hands: dict[str, Hand]  # those that lead an arm
    events: list[Event]
    damage: str | None  # why the file could be read no farther
    ended_by: str | None = None  # the fault that ended the run
    success: bool | None = None  # by the task's own check or the operator; None: nobody said
    part: int | None = None  # of the recording's episodes, from 1 on; None: the whole
    discarded: bool = False  # by its operator
    ended_by_operator: bool = False  # while the run went on

    @property
    def arms(self) -> tuple[str, ...]:
        """Their names, in the order of columns."""
        return self.recording.about.arms

    @property
    def frame_t(self) -> Array:
        """(m,) times of the frames [s]."""
        return self.ticks.t[self.frames.at]

    @property
    def engaged(self) -> Flags:
        """(m, arms) at the frames, as long as the run does not end."""
        at = self.frames.at
        return np.asarray(self.ticks.engaged[at] & self.ticks.following[at, None])

    @property
    def ended(self) -> bool:
        """Whether the run came to its end and the file was closed, or the operator ended the episode before."""
        if self.ended_by_operator:
            return True
        return self.recording.closed and bool(len(self.ticks.t)) and not self.ticks.following[-1]


def read_episode(recording: Recording) -> Episode:
    """Read a recording, and if it is damaged all before that.

    Raises :class:`RecordingError` where its cell cannot be built.
    """
    config, robot = cell_and_robot_of(recording)
    reader = _Reader(recording)
    damage = reader.read()
    ticks, frames = reader.ticks(), reader.frames()
    if len(frames.at) and damage is None:
        try:
            check_tools(reader.first_reference, frames.reference[0], robot)
        except RecordingError as error:
            raise RecordingError(f"{recording.file}: {error}") from error
    swapped = config.teleop.stance is not Stance.SIDE_BY_SIDE
    arms = {SIDES[1 - SIDES.index(arm)] if swapped else arm: arm for arm in recording.about.arms}
    hands = {hand: reader.hand(hand, arm, ticks) for hand, arm in arms.items()}
    tools = tool_poses(frames.q, robot)
    said = Conclusion()
    if damage is None:
        try:
            said = recording.conclusion
        except RecordingError as error:
            damage = str(error)
    return Episode(recording, config, ticks, frames, tools, hands, reader.events, damage, said.ended_by, said.success)


class _Reader:
    """Gathers arrays chunk by chunk."""

    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._ticks: list[Ticks] = []
        self._frames: list[Frames] = []
        self._samples: list[Column] = []
        self._count, self._slot = 0, -1
        self._origin: float | None = None  # of the loop's clock [s]
        self.events: list[Event] = []
        self.first_reference: Array = np.empty(0)

    def read(self) -> str | None:
        """All there is; returns what is damaged."""
        try:
            for ticks in ticks_of(self._recording):
                self._add(ticks)
        except RecordingError as error:
            return str(error).removeprefix(f"{self._recording.file}: ")
        except (ValueError, KeyError, IndexError, TypeError) as error:
            return f"damaged: {error!r:.200}"
        return None

    def ticks(self) -> Ticks:
        return _joined(Ticks, self._ticks, _no_ticks(len(self._recording.about.arms)))

    def frames(self) -> Frames:
        about = self._recording.about
        return _joined(Frames, self._frames, _no_frames(len(about.arms), len(about.joints)))

    def hand(self, hand: str, arm: str, ticks: Ticks) -> Hand:
        rows = np.concatenate(self._samples) if self._samples else np.empty((0, len(names.SAMPLE_FIELDS)))
        rows = rows[rows[:, 1] == SIDES.index(hand)]
        at = np.searchsorted(ticks.number, rows[:, 0])
        known = at < len(ticks.number)
        rows, at = rows[known], at[known]
        return Hand(arm, rows[:, 2] - (self._origin or 0.0), ticks.t[at], rows[:, 4:7])

    def _add(self, chunk: ChunkTicks) -> None:
        ticks = _ticks(chunk, self._recording.about.epoch)
        if self._origin is None:
            self._origin = float(chunk.number(names.TICK, "now")[0]) - float(ticks.t[0])
            self.first_reference = chunk.rows(names.REFERENCE)["positions"][0].copy()
        slots = np.floor(ticks.t / FRAME).astype(np.int64)
        at = np.flatnonzero(np.diff(slots, prepend=self._slot) > 0)
        frames = _frames(chunk, at, self._count)
        events = list(events_of(chunk.chunk))
        if names.SAMPLES in chunk.chunk.rows:
            self._samples.append(chunk.chunk.rows[names.SAMPLES]["data"])
        self._ticks.append(ticks)
        self._frames.append(frames)
        self.events += events
        self._count, self._slot = self._count + len(ticks.t), int(slots[-1])


def _ticks(chunk: ChunkTicks, epoch: int) -> Ticks:
    def flag(name: str) -> Flags:
        return chunk.number(names.FLAGS, name) > 0.5

    return Ticks(
        number=chunk.numbers,
        t=(chunk.times - epoch) / _NANOSECONDS,
        dt=chunk.number(names.TICK, "dt"),
        compute_time=chunk.number(names.TICK, "compute_time"),
        following=chunk.number(names.TICK, "following") > 0.5,
        certified=flag("certified"),
        fallback=flag("fallback"),
        distance=chunk.number(names.FLAGS, "closest_distance"),
        margin=chunk.number(names.FLAGS, "margin"),
        engaged=chunk.of_arms(names.FLAGS, "engaged") > 0.5,
        rejected=chunk.of_arms(names.FLAGS, "rejected") > 0.5,
        slip=chunk.of_arms(names.FLAGS, "slip"),
        slip_angle=chunk.of_arms(names.FLAGS, "slip_angle"),
        gripper=chunk.of_arms(names.GRIPPERS, "wanted"),
    )


def _frames(chunk: ChunkTicks, at: npt.NDArray[np.int64], before: int) -> Frames:
    reference = chunk.reference_tools()
    return Frames(
        at=before + at,
        q=chunk.rows(names.JOINT_STATES)["position"][at],
        target=chunk.targets(otherwise=reference)[at],
        reference=reference[at],
    )


def _no_ticks(arms: int) -> Ticks:
    none, flags = np.empty(0), np.empty(0, dtype=bool)
    of_arms, arm_flags = np.empty((0, arms)), np.empty((0, arms), dtype=bool)
    return Ticks(
        *(np.empty(0, dtype=np.int64), none, none, none, flags, flags, flags, none, none),
        *(arm_flags, arm_flags, of_arms, of_arms, of_arms),
    )


def _no_frames(arms: int, joints: int) -> Frames:
    poses = np.empty((0, arms, 7))
    return Frames(np.empty(0, dtype=np.int64), np.empty((0, joints)), poses, poses)


_Table = TypeVar("_Table", Ticks, Frames)


def _joined(kind: type[_Table], parts: list[_Table], nothing: _Table) -> _Table:
    """All parts one after the other."""
    columns: dict[str, Any] = {
        field.name: np.concatenate([getattr(part, field.name) for part in (nothing, *parts)]) for field in fields(kind)
    }
    return kind(**columns)
