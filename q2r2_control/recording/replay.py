"""A recorded run once more: the pipeline's own loop, with what it took before as its clock, input and plant."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from q2r2_control.config import Config
from q2r2_control.config.cell import parse_config
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution, Solver, make_solver
from q2r2_control.drives import permitted
from q2r2_control.errors import PlantError, RecordingError
from q2r2_control.pipeline import Pipeline
from q2r2_control.recording import topics as names
from q2r2_control.recording.comparison import Comparison, changes
from q2r2_control.recording.episode_spans import events_of_ticks
from q2r2_control.recording.packing import HAND_FAULTS, NOT_MEASURED
from q2r2_control.recording.reader import RecordedChunk, Recording
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.loop_clock import LoopClock
from q2r2_control.runtime.recorder import RunStart
from q2r2_control.runtime.run_summary import RunSummary
from q2r2_control.types import (
    SIDES,
    Array,
    Command,
    CommandMode,
    Event,
    HandInputs,
    HandSample,
    HapticFeedback,
    RobotState,
)


@dataclass(frozen=True, slots=True)
class RecordedTick:
    """What one tick took."""

    number: int
    now: float
    dt: float
    following: bool
    connected: bool
    samples: list[HandSample]
    state: RobotState
    openings: dict[str, float]
    unsolved: int
    events: list[Event]


class RecordedTicks:
    """The ticks of a recording, one after the other. Ends before the first that is missing."""

    def __init__(self, recording: Recording, comparison: Comparison) -> None:
        self._arms, self._joints = recording.about.arms, len(recording.about.joints)
        self._labels = recording.topics.by_name[names.TICK].labels["data"]
        self._comparison = comparison
        self._chunks = recording.chunks()
        self._ticks = self._all()
        self._starts: list[RunStart] = []
        self.missing = 0  # ticks that were lost behind the last one
        self.count = 0
        self.current: RecordedTick | None = None
        self.next = next(self._ticks, None)
        if self.next is None or not self._starts:
            raise RecordingError(f"{recording.file}: no tick was recorded")
        self.start = self._starts[0]

    def advance(self) -> RecordedTick:
        """Go on to the next tick. Raises :class:`NoMoreTicksError` behind the last."""
        if self.next is None:
            raise NoMoreTicksError
        self.current, self.next = self.next, next(self._ticks, None)
        self.count += 1
        return self.current

    def _all(self) -> Iterator[RecordedTick]:
        expected = 0
        for chunk in self._chunks:
            self._comparison.expect(chunk)
            if names.START in chunk.rows:
                self._starts.append(self._start_of(chunk))
            for tick in self._ticks_of(chunk):
                if tick.number != expected:
                    self.missing = tick.number - expected
                    return
                yield tick
                expected += 1

    def _start_of(self, chunk: RecordedChunk) -> RunStart:
        now, stamp, external, *joints = chunk.rows[names.START]["data"][0].tolist()
        q, v, tau, felt = np.array(joints).reshape(4, self._joints)
        return RunStart(now, RobotState(q, v, tau, felt if external else None, stamp))

    def _ticks_of(self, chunk: RecordedChunk) -> Iterator[RecordedTick]:
        if names.TICK not in chunk.rows:
            return
        states = chunk.rows[names.JOINT_STATES]
        felt = deque(chunk.rows[names.EXTERNAL_TORQUE]["effort"]) if names.EXTERNAL_TORQUE in chunk.rows else deque()
        samples = deque(chunk.rows[names.SAMPLES]["data"]) if names.SAMPLES in chunk.rows else deque()
        events = events_of_ticks(chunk)
        for numbers, state in zip(chunk.rows[names.TICK]["data"], states, strict=True):
            tick = dict(zip(self._labels, numbers.tolist(), strict=True))
            openings = {arm: tick[f"opening_{arm}"] for arm in self._arms}
            yield RecordedTick(
                number=int(tick["index"]),
                now=tick["now"],
                dt=tick["dt"],
                following=bool(tick["following"]),
                connected=bool(tick["connected"]),
                samples=[_sample(samples.popleft()) for _ in range(int(tick["samples"]))],
                state=RobotState(
                    q=state["position"].copy(),
                    v=state["velocity"].copy(),
                    tau=state["effort"].copy(),
                    tau_external=felt.popleft().copy() if tick["external"] else None,
                    stamp=tick["state_stamp"],
                ),
                openings={arm: opening for arm, opening in openings.items() if opening != NOT_MEASURED},
                unsolved=int(tick["unsolved"]),
                events=events.get(int(tick["index"]), []),
            )


class NoMoreTicksError(Exception):
    """There are no more ticks: the run was killed, or some were lost."""


class ReplayPipeline(Pipeline):
    """Runs the loop with the clock, input and plant of a recording, and its solver as late as it was then."""

    def __init__(self, config: Config, robot: Robot, ticks: RecordedTicks, mode: str, modes: tuple[str, ...]) -> None:
        super().__init__(config, robot, _Input(ticks, self._wish_again), _Plant(ticks, modes), mode)
        self._recorded = ticks

    def make_clock(self, realtime: bool) -> LoopClock:
        """See :meth:`Pipeline.make_clock`."""
        return _Clock(1.0 / self.config.loop_rate_hz, self._recorded)

    def _wish_again(self, events: list[Event]) -> None:
        """What a program asked of the run at this tick; both arms were told of it, so it is asked twice."""
        for event in events:
            self.wishes.take(event.reason, self.teleop.settings)

    def _prepare(self, realtime: bool) -> None:
        settings = permitted(self.config.control.model_copy(update={"solve_time_limit": None}), self.drive)
        inner = make_solver(settings.solver, self.robot.model.nv, None)
        self.controller = CartesianController(self.robot, settings, solver=_Solver(inner, self._recorded))
        super()._prepare(realtime)


@dataclass(frozen=True, slots=True)
class Replay:
    """What came of a replay."""

    ticks: int
    summary: RunSummary | None  # None: the recording has no end, or a fault ended the run
    ended_by: str | None  # that fault, or why it ended before the recording did
    difference: str | None  # the first one; None: identical
    notes: list[str]  # what is not as it was when it was recorded


def replay(path: Path, config: Config | None = None) -> Replay:
    """Run a recording again, with its own cell or another one.

    Raises :class:`RecordingError` for a file that is none or is damaged, and :class:`Q2R2Error` for a cell that cannot
    be built or whose arms and joints have other names.
    """
    recording = Recording(path)
    about = recording.about
    cell = config or parse_config(about.cell, f"{recording.file}: its cell")
    robot = Robot.from_config(cell)
    if tuple(robot.arms) != about.arms or tuple(robot.joint_names) != about.joints:
        raise RecordingError(f"{recording.file}: recorded with other arms or joints than {cell.name} has")
    notes = changes(about, cell, robot)
    comparison = Comparison(robot, recording.topics, about.epoch)
    ticks = RecordedTicks(recording, comparison)
    pipeline = ReplayPipeline(cell, robot, ticks, about.mode, about.plant_modes)
    pipeline.listeners.append(comparison)
    summary, ended_by = None, None
    try:
        summary = pipeline.run(realtime=False)
    except NoMoreTicksError:
        ended_by = _end_of(ticks)
    except PlantError as error:
        ended_by = str(error)
    comparison.finish(whole=not ticks.missing)
    return Replay(ticks.count, summary, ended_by, comparison.difference, notes)


def _end_of(ticks: RecordedTicks) -> str:
    """Why there are no more ticks."""
    if ticks.missing:
        return f"{ticks.missing} ticks were lost here when it was recorded"
    if ticks.current is not None and ticks.current.following:
        return "the recording has no end: its process was killed, or the disk was full"
    return "the arms were at rest here when it was recorded, and are not now"


class _Clock(LoopClock):
    """Ticks when they came."""

    def __init__(self, period: float, ticks: RecordedTicks) -> None:
        super().__init__(period, realtime=False)
        self._recorded = ticks
        self.start = self.now = ticks.start.now

    def wait(self) -> float:
        """See :meth:`LoopClock.wait`."""
        tick = self._recorded.advance()
        self.now = tick.now
        return tick.dt

    def after(self, duration: float) -> bool:
        """Whether the run was ended then, whatever by."""
        return self._recorded.next is not None and not self._recorded.next.following


class _Input:
    """The samples of the recorded tick. Implements :class:`Input`."""

    def __init__(self, ticks: RecordedTicks, tell: Callable[[list[Event]], None]) -> None:
        self._ticks, self._tell = ticks, tell

    @property
    def connected(self) -> bool:
        return self._ticks.current is not None and self._ticks.current.connected

    def start(self) -> None:
        pass

    def poll(self, now: float) -> list[HandSample]:
        if self._ticks.current is None:
            return []
        self._tell(self._ticks.current.events)
        return self._ticks.current.samples

    def send_haptic(self, feedback: HapticFeedback) -> None:
        pass

    def close(self) -> None:
        pass


class _Plant:
    """What was measured at the recorded tick; commands move nothing. Implements :class:`Plant`."""

    def __init__(self, ticks: RecordedTicks, modes: tuple[str, ...]) -> None:
        self._ticks = ticks
        self.modes = tuple(CommandMode(mode) for mode in modes)

    def reset(self, q: Array | None = None) -> None:
        pass

    def apply(self, command: Command) -> None:
        pass

    def advance(self, dt: float) -> None:
        pass

    def state(self) -> RobotState:
        return self._ticks.start.state if self._ticks.current is None else self._ticks.current.state

    def gripper_openings(self) -> dict[str, float]:
        return {} if self._ticks.current is None else self._ticks.current.openings

    def close(self) -> None:
        pass


class _Solver:
    """Has no solution in those substeps in which there was none, or none in time."""

    def __init__(self, solver: Solver, ticks: RecordedTicks) -> None:
        self._solver, self._ticks = solver, ticks
        self._tick: RecordedTick | None = None
        self._substep = 0

    def solve(self, problem: QpProblem) -> QpSolution:
        tick = self._ticks.current
        self._substep = self._substep + 1 if tick is self._tick else 0
        self._tick = tick
        if tick is not None and tick.unsolved >> self._substep & 1:
            return QpSolution(None, 0.0)
        return self._solver.solve(problem)


def _sample(numbers: Array) -> HandSample:
    values = dict(zip(names.SAMPLE_FIELDS, numbers.tolist(), strict=True))
    inputs = {name: values[name] for name in HandInputs.__slots__}
    for button in ("button_upper", "button_lower"):
        inputs[button] = bool(inputs[button])
    return HandSample(
        hand=SIDES[int(values["hand"])],
        position=numbers[4:7].copy(),
        quaternion=numbers[7:11].copy(),
        pose_stamp=values["pose_stamp"],
        inputs=HandInputs(**inputs),
        inputs_stamp=values["inputs_stamp"],
        fault=HAND_FAULTS[int(values["fault"])],
    )
