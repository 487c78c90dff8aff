"""Read a recording into arrays: some numbers of every tick, and poses about a hundred times a second."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import TypeVar

import numpy as np
import numpy.typing as npt

from q2r2_control.config.cell import Config
from q2r2_control.errors import RecordingError
from q2r2_control.events import Event
from q2r2_control.judging.pictures import Pictures, read_pictures
from q2r2_control.recording.about import Conclusion
from q2r2_control.recording.messages import NANOSECONDS, is_compressed
from q2r2_control.recording.reader import Recording
from q2r2_control.recording.recorded_ticks import cell_and_robot_of, check_tools, tool_poses
from q2r2_control.recording.tick_chunks import TickChunk
from q2r2_control.recording.tick_rows import SAMPLE_FIELDS, Rows, targets_or_tools, tick_type
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array, Flags

FRAME = 0.01  # The time from one frame to the next [s]. A frame is a tick whose poses are kept.
SPEED_OVER = 0.02  # A measured speed is an average over at least this time, since ticks are not evenly spaced [s].


@dataclass(frozen=True)
class Ticks:
    """One row for each of n ticks that are in the file."""

    number: npt.NDArray[np.int64]  # (n,) Number of the tick. Ticks are counted from 0, and lost ticks count too.
    t: Array  # (n,) Time since the run began [s].
    dt: Array  # (n,) Time since the loop's previous tick, even if that tick is not in the file [s].
    compute_time: Array  # (n,) Computing time of the tick [s].
    following: Flags  # (n,) False while the run ends and the arms come to rest.
    certified: Flags  # (n,) True if the controller had a certified stop.
    fallback: Flags  # (n,) True if the certified stop was executed.
    distance: Array  # (n,) Distance of the nearest pair [m].
    margin: Array  # (n,) Distance of the tightest pair minus the distance that it has to keep [m].
    engaged: Flags  # (n, arms) True if the arm is engaged.
    by_policy: Flags  # (n, arms) True if the arm is engaged and a policy moves it.
    rejected: Flags  # (n, arms) True if the controller could not use the arm's target.
    slip: Array  # (n, arms) Distance by which the leash has dragged the target since engaging [m].
    slip_angle: Array  # (n, arms) Angle by which the leash has dragged the target since engaging [rad].
    gripper: Array  # (n, arms) The gripper's opening that the operator wants, 0 closed .. 1 open.
    now: Array  # (n,) Time of the tick by the loop's own clock [s].
    unmeasured: Flags  # (n, arms) True if a measured number, or a number of the reference, is not finite.
    joint_speed: Array  # (n, arms) Largest ratio of a measured joint speed to the speed limit of that joint.


@dataclass(frozen=True)
class Frames:
    """One row for each of m ticks that are :data:`FRAME` apart. Poses are x y z [m] qx qy qz qw in the world."""

    at: npt.NDArray[np.int64]  # (m,) The rows of these ticks in :class:`Ticks`.
    q: Array  # (m, joints) Measured positions [rad].
    target: Array  # (m, arms, 7) The operator's targets, or ``reference`` where there is no target.
    reference: Array  # (m, arms, 7) Tool poses at the controller's reference.
    v: Array  # (m, joints) Measured velocities [rad/s].
    reference_q: Array  # (m, joints) Joint positions of the controller's reference [rad].
    opening: Array  # (m, arms) Measured openings of grippers, 0 closed .. 1 open; -inf if not measured.
    commanded: Array  # (m, arms) Commanded openings of grippers, 0 closed .. 1 open; -inf without a command.


@dataclass(frozen=True)
class Hand:
    """The k received samples of one hand. Some poses can contain NaN or infinite numbers."""

    arm: str  # The arm that follows the hand.
    received: Array  # (k,) Time of the receipt of the pose [s].
    polled: Array  # (k,) Time of the tick that took the sample [s].
    position: Array  # (k, 3) Position in the input's frame [m].


@dataclass(frozen=True)
class Episode:
    """One recording, or one episode of a recording. Times are measured from its beginning [s]."""

    recording: Recording
    config: Config
    robot: Robot
    ticks: Ticks
    frames: Frames
    tools: Array  # (m, arms, 7) Measured tool poses, with one row for each row of ``frames``.
    hands: dict[str, Hand]  # The hands that an arm follows, by name.
    events: list[Event]
    damage: str | None  # The reason why the file cannot be read to its end; None if it can.
    # The pictures of each camera. Cameras whose pictures were not read, or cannot be read, are missing.
    pictures: dict[str, Pictures] = field(default_factory=dict)
    ended_by: str | None = None  # The fault that ended the run; None if no fault did.
    # True if the episode succeeded, as the task's own check or the operator says; None if that is not known.
    success: bool | None = None
    part: int | None = None  # The number of the episode, from 1 on; None for the whole recording.
    discarded: bool = False  # True if the operator discarded the episode.
    ended_by_operator: bool = False  # True if the operator ended the episode while the run went on.
    subtask_starts: tuple[float, ...] = ()  # Times at which the operator began another subtask [s].

    @property
    def arms(self) -> tuple[str, ...]:
        return self.recording.about.arms

    @property
    def frame_t(self) -> Array:
        """Return the times (m,) of the frames [s]."""
        return self.ticks.t[self.frames.at]

    @property
    def engaged(self) -> Flags:
        """Return which arms are engaged (m, arms) at the frames; False while the run ends."""
        at = self.frames.at
        return np.asarray(self.ticks.engaged[at] & self.ticks.following[at, None])

    @property
    def ended(self) -> bool:
        """Return whether the episode is complete.

        Either the operator ended the episode during the run, or the arms came to rest and the file was closed.
        """
        if self.ended_by_operator:
            return True
        return self.recording.closed and not self.ticks.following[-1:].any()


def read_episode(recording: Recording, *, pictures: bool = True) -> Episode:
    """Read a recording, with or without its ``pictures``. A damaged file is read up to the damage.

    Raises :class:`RecordingError` if its cell cannot be built, or if its robot is not the recorded robot.
    """
    config, robot = cell_and_robot_of(recording)
    read = _Read(recording, robot)
    damage = read.all_chunks()
    ticks, frames, said = _joined(Ticks, read.ticks), _joined(Frames, read.frames), read.said
    if damage is None and len(frames.at):
        try:
            check_tools(read.first_reference, frames.reference[0], robot)
        except RecordingError as error:
            raise RecordingError(f"{recording.file}: {error}") from error
    arms = {config.teleop.stance.hand_of(arm): arm for arm in recording.about.arms}
    hands = {hand: read.hand(hand, arm, ticks) for hand, arm in arms.items()}
    tools = tool_poses(frames.q, robot)
    looked_at, damage = _pictures(recording, config, damage) if pictures else ({}, damage)
    return Episode(
        recording=recording,
        config=config,
        robot=robot,
        ticks=ticks,
        frames=frames,
        tools=tools,
        hands=hands,
        events=read.events,
        damage=damage,
        pictures=looked_at,
        ended_by=said.ended_by,
        success=said.success,
    )


def _pictures(recording: Recording, config: Config, damage: str | None) -> tuple[dict[str, Pictures], str | None]:
    """Return the pictures by the camera's name, and the reason why the file is damaged, or None.

    There are no pictures if the file is damaged, either by ``damage`` or within its pictures.
    """
    chosen = {name: config.cameras[name] for name in recording.about.cameras if name in config.cameras}
    chosen = {name: camera for name, camera in chosen.items() if camera.topic is None or is_compressed(camera.topic)}
    if damage is not None or not chosen:
        return {}, damage
    try:
        return read_pictures(recording, chosen), None
    except RecordingError as error:
        return {}, str(error).removeprefix(f"{recording.file}: ")


class _Read:
    def __init__(self, recording: Recording, robot: Robot) -> None:
        self._recording = recording
        self._limits = robot.velocity_limit
        self._joints = [arm.joints for arm in robot.arms.values()]
        # A joint that can make a full turn may be measured modulo one turn.
        self._wraps = robot.position_upper - robot.position_lower >= 2.0 * np.pi
        self._last: tuple[float, Array] | None = None  # Time [s] and measured joints of the newest tick.
        self.ticks: list[Ticks] = []
        self.frames: list[Frames] = []
        self.events: list[Event] = []
        self.said = Conclusion()
        self.first_reference: Array = np.empty(0)
        self._samples: list[Array] = []
        self._count, self._slot = 0, -1
        self._origin = 0.0  # Time of the loop's clock at the beginning of the recording [s].
        about = recording.about
        rows, times = np.empty(0, tick_type(len(about.arms), len(about.joints))), np.empty(0, np.int64)
        # If the recording has no tick, this empty chunk gives its arrays the right shapes.
        self._add(TickChunk(rows, times, np.empty((0, len(SAMPLE_FIELDS))), {}))

    def all_chunks(self) -> str | None:
        """Read all chunks. Return the reason why the file is damaged; None if it is not."""
        try:
            for chunk in self._recording.chunks():
                self._add(chunk)
            self.said = self._recording.conclusion
        except RecordingError as error:
            return str(error).removeprefix(f"{self._recording.file}: ")
        except (ValueError, KeyError, IndexError, TypeError) as error:
            return f"damaged: {error!r:.200}"
        return None

    def _add(self, chunk: TickChunk) -> None:
        self.events += [event for events in chunk.events().values() for event in events]
        self._samples.append(chunk.samples)
        rows, arms = chunk.rows, chunk.rows["arms"]
        t = (chunk.times - self._recording.about.epoch) / NANOSECONDS
        if len(t) and not self._count:
            self._origin = float(rows["now"][0]) - float(t[0])
            self.first_reference = rows["reference_q"][0].copy()
        ticks = Ticks(
            number=chunk.numbers,
            t=t,
            dt=rows["dt"],
            compute_time=rows["compute_time"],
            following=rows["following"] > 0.5,
            certified=rows["certified"] > 0.5,
            fallback=rows["fallback"] > 0.5,
            distance=rows["closest_distance"],
            margin=rows["margin"],
            engaged=arms["engaged"] > 0.5,
            by_policy=arms["policy"] > 0.5,
            rejected=arms["rejected"] > 0.5,
            slip=arms["slip"],
            slip_angle=arms["slip_angle"],
            gripper=arms["wanted"],
            now=rows["now"],
            unmeasured=self._unmeasured(rows),
            joint_speed=self._joint_speed(t, rows["q"]),
        )
        slots = np.floor(t / FRAME).astype(np.int64)
        at = np.flatnonzero(np.diff(slots, prepend=self._slot) > 0)
        shown = rows[at]
        self.ticks.append(ticks)
        poses = targets_or_tools(shown), shown["arms"]["tool"]
        joints = shown["v"], shown["reference_q"]
        openings = shown["arms"]["opening"], shown["arms"]["commanded"]
        self.frames.append(Frames(self._count + at, shown["q"], *poses, *joints, *openings))
        self._count, self._slot = self._count + len(t), int(slots.max(initial=self._slot))

    def _unmeasured(self, rows: Rows) -> Flags:
        """Return which arms (n, arms) have a number that is not finite.

        Torques do not count, since NaN means that they are not measured, and neither does an opening of -inf.
        """
        finite = np.all([np.isfinite(rows[name]) for name in ("q", "v", "reference_q", "reference_v")], axis=0)
        openings = rows["arms"]["opening"]
        bad = [~finite[:, joints].all(axis=1) for joints in self._joints]
        return np.stack(bad, axis=1) | np.isnan(openings) | (openings == np.inf)

    def _joint_speed(self, t: Array, q: Array) -> Array:
        """Return the column ``joint_speed`` (n, arms) of :class:`Ticks`; numbers that are not finite count as 0."""
        if not len(t):
            return np.empty((0, len(self._joints)))
        before_t, before_q = self._last if self._last is not None else (t[0], q[0])
        self._last = float(t[-1]), q[-1].copy()
        steps = np.diff(q, axis=0, prepend=before_q[None])
        steps -= np.where(self._wraps, 2.0 * np.pi * np.rint(steps / (2.0 * np.pi)), 0.0)
        passed = np.maximum(np.diff(t, prepend=before_t), SPEED_OVER)
        shares = np.nan_to_num(np.abs(steps) / passed[:, None] / self._limits, posinf=0.0)
        return np.stack([shares[:, joints].max(axis=1) for joints in self._joints], axis=1)

    def hand(self, hand: str, arm: str, ticks: Ticks) -> Hand:
        rows = np.concatenate(self._samples)
        rows = rows[(rows[:, 1] == SIDES.index(hand)) & (rows[:, 0] <= ticks.number.max(initial=-1))]
        polled = ticks.t[np.searchsorted(ticks.number, rows[:, 0])]
        return Hand(arm, rows[:, 2] - self._origin, polled, rows[:, 4:7])


_Table = TypeVar("_Table", Ticks, Frames)


def _joined(kind: type[_Table], parts: list[_Table]) -> _Table:
    columns = zip(*(vars(part).values() for part in parts), strict=True)
    return kind(*map(np.concatenate, columns))


def stretches(flags: Flags) -> list[tuple[int, int]]:
    """Return the first index and the end index (exclusive) of each group of successive true ``flags`` (n,)."""
    edges = np.flatnonzero(np.diff(np.concatenate(([False], flags, [False]))))
    return [(int(begin), int(end)) for begin, end in edges.reshape(-1, 2)]
