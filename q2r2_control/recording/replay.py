"""Runs a recording again, in the pipeline's own loop. Recorded data replaces the loop's clock, input and plant."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pinocchio as pin

from q2r2_control.cameras.reasons import CameraReason
from q2r2_control.config.cell import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.qp import QpProblem, QpSolution, Solver
from q2r2_control.control.solvers.registry import solver_of
from q2r2_control.device_words import QUEST_WORDS
from q2r2_control.drives.base import permitted
from q2r2_control.errors import ConfigError, PlantError, RecordingError
from q2r2_control.pipeline.loop_clock import LoopClock, WallPace
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.base import make_plant
from q2r2_control.plugins import PLANTS, load_class
from q2r2_control.recording.about import ROS, About, changes
from q2r2_control.recording.reader import NO_END, Recording
from q2r2_control.recording.recorded_ticks import NoMoreTicksError, RecordedTick, RecordedTicks, cell_and_robot_of
from q2r2_control.recording.tick_rows import NOT_REPLAYED, TickPacker, tick_labels
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.run_summary import RunSummary
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import (
    QUEST_CONTROLS,
    ActionChunk,
    Array,
    Command,
    CommandMode,
    HandSample,
    HapticFeedback,
    Observation,
    RobotState,
)


@dataclass(frozen=True, slots=True)
class ArmDifference:
    """The differences between an arm's measured tool poses in the replay and in the recording, at the same ticks."""

    position_mm_rms: float
    position_mm_max: float
    rotation_deg_max: float


_REPEATABLE = ("mujoco", "kinematic")  # Plants that can move in a replay.
# Kinds of requests that a replay repeats. The end of a recording is not repeated.
_REPEATED = {
    *(
        TeleopReason.HOME_REQUESTED,
        TeleopReason.PAUSE_REQUESTED,
        TeleopReason.POLICY_REQUESTED,
        TeleopReason.ENGAGE_REQUESTED,
    ),
    TeleopReason.OBSTACLE_REPORTED,
    *(
        TeleopReason.RECORDING_REQUESTED,
        TeleopReason.SETTINGS_REQUESTED,
        TeleopReason.CONTROL_REQUESTED,
        TeleopReason.VERDICT,
    ),
    *(CameraReason.CAMERA_STOPPED, CameraReason.CAMERA_SLOW, CameraReason.CAMERA_OTHER_SIZE, CameraReason.CAMERA_BACK),
}


@dataclass(frozen=True, slots=True)
class Replay:
    """The result of a replay."""

    ticks: int  # The number of ticks that were replayed.
    summary: RunSummary | None  # The summary of the replay; None if it ended before its first tick.
    # The fault that ended the replay, or the reason why it ended earlier than the recorded run; otherwise None.
    ended_by: str | None
    # The first difference between replay and recording in words; None if there is none or nothing was compared.
    difference: str | None
    notes: list[str]  # The changes of program, cell and robot since the run was recorded.
    arms: dict[str, ArmDifference]  # The differences of each arm's tool poses; empty if no plant moved.


def replay(
    path: Path,
    config: Config | None = None,
    plant: str | None = None,
    *,
    compare: bool = True,
    prepare: Callable[[Pipeline], None] = lambda pipeline: None,
    paced: bool = False,
) -> Replay:
    """Run a recording again, with its own cell or with another cell.

    Without a ``plant``, the loop gets the recorded measurements, whatever it commands. With a ``plant``, that plant
    moves, and the loop gets its measurements. Only the kind of plant that was recorded can repeat the run to the bit.

    Args:
        path: The recording, or a folder with one recording.
        config: The cell; None for the recorded cell.
        plant: The name of a plant; None for the recorded measurements.
        compare: Whether to compare each tick with the recorded tick, bit by bit. It has to be False if ``plant`` is of
            another kind than the recorded plant. Without a ``plant``, ticks are always compared.
        prepare: Called with the pipeline before the run.
        paced: True if the replay must not be faster than the recorded run.

    Returns:
        The result of the replay.

    Raises:
        RecordingError: If the file is not a recording of a loop, or is damaged.
        Q2R2Error: If the cell cannot be built or has other arms or joints, or if the plant cannot be driven in the
            recorded mode.
    """
    recording = Recording(path)
    about = recording.about
    if about.source == ROS:
        raise RecordingError(
            f"{recording.file}: recorded from ROS nodes, which keeps messages and not what each loop took, so there is "
            "nothing to replay to the bit; ros2 bag play plays it, q2r2 judge and q2r2 export read it"
        )
    cell, robot = cell_and_robot_of(recording, config)
    if plant is not None and getattr(load_class(PLANTS, plant), "realtime_only", False):
        raise ConfigError(
            f"--plant {plant}: it keeps real time; allowed in a replay: {', '.join(_REPEATABLE)}; its arms follow the "
            f"recorded hands with q2r2 run CELL --plant {plant} --input recording --recording {recording.file}"
        )
    ticks = RecordedTicks(recording)
    pipeline = ReplayPipeline(cell, robot, ticks, about, plant)
    comparison = _Comparison(about, ticks) if compare or plant is None else None
    if comparison is not None:
        recorded = about.notes.get("plant", "another plant")
        if plant is not None and recorded != type(pipeline.plant).__name__:
            names = {load_class(PLANTS, name).__name__: name for name in _REPEATABLE}
            allowed = f"--plant {names[recorded]}, or none" if recorded in names else "no --plant"
            raise ConfigError(f"--plant {plant}: recorded with {recorded}; allowed with --compare: {allowed}")
        pipeline.listeners.append(comparison)
    difference = _PlantDifference(robot, ticks)
    if plant is not None:
        pipeline.listeners.append(difference)
    prepare(pipeline)
    summary, ended_by = None, None
    try:
        summary = pipeline.run(realtime=False, paced=paced)
    except NoMoreTicksError:
        ended_by = "the arms were at rest here when it was recorded, and are not now"
        if ticks.missing:
            ended_by = f"{ticks.missing} ticks were lost here when it was recorded"
        elif ticks.current is not None and ticks.current.following:
            ended_by = NO_END
    except PlantError as error:
        ended_by = str(error)
    if summary is None and ticks.current is not None:
        summary = pipeline.summary_so_far()
    found = None if comparison is None else comparison.finish()
    count = 0 if ticks.current is None else ticks.current.number + 1
    return Replay(count, summary, ended_by, found, changes(about, cell, robot), difference.arms())


class ReplayPipeline(Pipeline):
    """Runs the loop with the clock and input of a recording.

    Its solver fails in the same substeps in which the solver of the recorded run failed.
    """

    def __init__(self, config: Config, robot: Robot, ticks: RecordedTicks, about: About, plant: str | None) -> None:
        """``plant`` is the name of a plant. If it is None, the loop gets the recorded measurements."""
        recorded = _Recorded(ticks, about.plant_modes, self._ask_again)
        # A recording does not say which extra buttons the device had. It is assumed to have all bound buttons.
        buttons = QUEST_CONTROLS.buttons + config.teleop.bindings.of_device
        recorded.controls = replace(_Recorded.controls, buttons=buttons)
        moves = recorded if plant is None else make_plant(plant, robot, config)
        super().__init__(config, robot, recorded, moves, about.mode)
        self._recorded = ticks

    def make_clock(self, realtime: bool) -> LoopClock:
        return _Clock(1.0 / self.config.nominal_rate_hz, self._recorded, self._pace)

    def summary_so_far(self) -> RunSummary:
        """Return the summary of all ticks so far. The run must have begun."""
        return self._recorder.finish(self._clock, self.loop.pacer)

    def _ask_again(self, tick: RecordedTick) -> None:
        """Repeat the requests that a program made at this tick.

        Such a request was recorded as one event for each arm. These events are equal and do not change the state of an
        arm, so only the events of the first arm are read.
        """
        first = next(iter(self.robot.arms))
        asked = (event for event in tick.events if event.arm == first and event.source == event.destination)
        self.requests.extend(event.reason for event in asked if event.kind in _REPEATED)

    def _prepare(self, realtime: bool) -> None:
        settings = permitted(self.config.control.timed(realtime=False), self.drive)
        inner = solver_of(settings, self.robot.model.nv)
        self.controller = CartesianController(
            self.robot, settings, solver=_Solver(inner, self._recorded), bridge_held=False
        )
        super()._prepare(realtime)


class _Clock(LoopClock):
    def __init__(self, period: float, ticks: RecordedTicks, pace: WallPace | None) -> None:
        super().__init__(period, realtime=False, pace=pace)
        self._recorded = ticks
        self.start = self.now = ticks.start.now

    def wait(self) -> float:
        tick = self._recorded.advance()
        self.now = tick.now
        self.keep_pace()
        return tick.dt

    def after(self, duration: float) -> bool:
        return self._recorded.next is not None and not self._recorded.next.following


class _Recorded:
    """The input and the plant of a replay: a PolicySource and a Plant that return the data of the recorded tick.

    Commands have no effect.
    """

    controls = replace(QUEST_CONTROLS, words=replace(QUEST_WORDS, nobody="this is a recording"))

    def __init__(self, ticks: RecordedTicks, modes: tuple[str, ...], on_tick: Callable[[RecordedTick], None]) -> None:
        self._ticks, self._on_tick = ticks, on_tick
        self.modes = tuple(CommandMode(mode) for mode in modes)

    @property
    def connected(self) -> bool:
        return self._ticks.current is not None and self._ticks.current.connected

    def poll(self, now: float) -> list[HandSample]:
        if self._ticks.current is None:
            return []
        self._on_tick(self._ticks.current)
        return self._ticks.current.samples

    def chunks(self) -> list[ActionChunk]:
        return [] if self._ticks.current is None else self._ticks.current.chunks

    def state(self) -> RobotState:
        return self._ticks.start.state if self._ticks.current is None else self._ticks.current.state

    def gripper_openings(self) -> dict[str, float]:
        return {} if self._ticks.current is None else self._ticks.current.openings

    def prepare(self, robot: Robot, realtime: bool) -> None: ...
    def observe(self, observation: Observation) -> None: ...
    def start(self) -> None: ...
    def send_haptic(self, feedback: HapticFeedback) -> None: ...
    def reset(self, q: Array | None = None) -> None: ...
    def apply(self, command: Command) -> None: ...
    def advance(self, dt: float) -> None: ...
    def close(self) -> None: ...


class _Solver:
    """A solver that returns no solution in the substeps in which the recorded run had no solution in time."""

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


class _PlantDifference:
    """A listener of a replay with a plant. It measures how far the tool poses are from the recorded tool poses."""

    keeps_episodes = True  # The recorder has the same value, so the operator's marks have the same effect in a replay.

    def __init__(self, robot: Robot, ticks: RecordedTicks) -> None:
        self._robot, self._ticks = robot, ticks
        self._data = robot.model.createData()
        # For each arm: the distance [m] and the angle [rad] at each tick.
        self._off: dict[str, list[tuple[float, float]]] = {name: [] for name in robot.arms}

    def __call__(self, tick: Tick) -> None:
        recorded = self._ticks.current
        if recorded is None or not np.isfinite(recorded.state.q).all():
            return
        pin.forwardKinematics(self._robot.model, self._data, recorded.state.q)
        for name, arm in self._robot.arms.items():
            off = pin.updateFramePlacement(self._robot.model, self._data, arm.frame_id).actInv(tick.tools[name])
            distance, angle = (float(np.linalg.norm(part)) for part in (off.translation, pin.log3(off.rotation)))
            self._off[name].append((distance, angle))

    def arms(self) -> dict[str, ArmDifference]:
        found = {}
        for name, off in self._off.items():
            if off:
                distances, angles = np.array(off).T
                rms = 1e3 * math.sqrt(float(np.mean(distances**2)))
                found[name] = ArmDifference(rms, 1e3 * float(distances.max()), math.degrees(float(angles.max())))
        return found


class _Comparison:
    """A listener of a replay that compares each tick with the recorded tick, bit by bit.

    Computing times are not compared.
    """

    keeps_episodes = True  # The recorder has the same value, so the operator's marks have the same effect in a replay.

    def __init__(self, about: About, ticks: RecordedTicks) -> None:
        self._ticks, self._packer = ticks, TickPacker(about.arms, about.joints)
        self._labels = tick_labels(about.arms, about.joints)
        left_out = [any(name in label.split(".") for name in NOT_REPLAYED) for label in self._labels]
        self._compared = np.flatnonzero(~np.array(left_out))
        self._difference: str | None = None

    def __call__(self, tick: Tick) -> None:
        recorded = self._ticks.current
        assert recorded is not None
        replayed = self._packer.pack(recorded.number, tick)
        if self._difference is None:
            found = self._difference_of_rows(recorded.packed.row, replayed.row)
            found = found or _difference_of_states(recorded.packed.state, replayed.state)
            if found is not None:
                self._difference = f"{tick.now - self._ticks.start.now:.6f} s: {found}"

    def finish(self) -> str | None:
        """Return the first difference in words, or None if there is none. Call it when the replay has ended.

        A recorded tick that was not replayed is a difference too.
        """
        if self._difference is None and self._ticks.next is not None:
            return f"{self._ticks.next.now - self._ticks.start.now:.6f} s: a tick was recorded only"
        return self._difference

    def _difference_of_rows(self, recorded: bytes, replayed: bytes) -> str | None:
        before, after = (np.frombuffer(row)[self._compared] for row in (recorded, replayed))
        for place in np.flatnonzero(before.view(np.uint64) != after.view(np.uint64)):
            return f"{self._labels[self._compared[place]]}: recorded {before[place]}, replayed {after[place]}"
        return None


def _difference_of_states(recorded: str, replayed: str) -> str | None:
    before, after = (json.loads(text) if text else {} for text in (recorded, replayed))
    for name in {**before, **after}:
        if before.get(name) != after.get(name):
            return f"{name}: recorded {before.get(name)!r}, replayed {after.get(name)!r}"
    return None if recorded == replayed else "state: told another time"
