"""Run one controller in one work motion and compute its figures, or run our controller and its peers in all motions.

All controllers run in one process, and get the same cell, limits, targets and ticks. Peers run open loop, as our
controller does. Each peer lags behind its targets, so it gets them earlier by this lag. Our controller also runs in
free air, where no pairs are monitored. The difference between its two runs is the cost of the monitored pairs.
"""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.peers.base import BenchController, Leading, PeerSettings, build_peers
from q2r2_control.benchmark.work_motions import WorkMotion
from q2r2_control.config.cell import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

DT = 0.001  # Duration of a tick [s].
ARRIVED = 0.01  # A tool within this distance of its goal has arrived [m].
PATIENCE = 3.0  # Longest computing time that a controller may take, as a multiple of the motion's duration.
JOLT = 5.0  # A larger change of a joint's acceleration in one tick is a jolt [rad/s^2].
_TAIL = 0.5  # The acceleration at rest is computed over this last part of a motion [s].
_SHORTEST_DT = 1e-9  # Duration of a tick in which no joint can move [s].
# First, distances are computed only in every fourth tick. Then they are computed in all ticks around the tick with the
# smallest of these distances.
_DISTANCE_TICKS = 4


class OwnController:
    """Our :class:`CartesianController` with the interface of a :class:`BenchController`.

    It has the settings of a cell, but no time limit for the solver. Thus a slow machine computes the same motion.
    """

    limitations = ""

    def __init__(self, robot: Robot, config: Config, name: str = "q2r2_control") -> None:
        self.name = name
        self._controller = CartesianController(robot, config.control.timed(realtime=False))
        # For each tick since the reset: whether the certified stop was executed, and whether any QP was not solved.
        self.stopped: list[bool] = []
        self.unsolved: list[bool] = []

    def reset(self, q: Array) -> None:
        self._controller.reset(q)
        self.stopped.clear()
        self.unsolved.clear()

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        reference = self._controller.step(targets, dt)
        self.stopped.append(reference.report.fallback)
        self.unsolved.append(reference.report.unsolved > 0)
        return reference.q, reference.v

    def hold(self) -> tuple[Array, Array]:
        """Return the same positions at rest. This is called only after an exception, which our contract forbids."""
        reference = self._controller.step({}, _SHORTEST_DT)
        return reference.q, np.zeros_like(reference.v)


def without_pairs(config: Config) -> Robot:
    """Return the robot of a cell without monitored pairs, so that its arms can move through everything."""
    robot = Robot.from_config(config)
    robot.collision_model.removeAllCollisionPairs()
    return robot


def rest_acceleration(v: Array, dt: float) -> float:
    """Return the RMS, over the last 0.5 s, of the norm of all joints' accelerations [rad/s^2].

    ``v`` (n, nv) are the velocities [rad/s] in ticks of ``dt`` [s].
    """
    a = np.diff(v, axis=0, prepend=0.0)[-round(_TAIL / dt) :] / dt
    return float(np.sqrt(np.mean(np.sum(a**2, axis=1))))


def count_jolts(v: Array, dt: float, since: float) -> int:
    """Count the ticks after ``since`` [s] in which a joint's acceleration changes by more than :data:`JOLT`.

    ``v`` (n, nv) are the velocities [rad/s] in ticks of ``dt`` [s].
    """
    a = np.diff(v, axis=0, prepend=0.0) / dt
    changes = np.abs(np.diff(a, axis=0)).max(axis=1)
    return int((changes[round(since / dt) :] > JOLT).sum())


@dataclass(frozen=True, slots=True)
class MotionFigures:
    """Figures of one controller in one motion. The approach is left out.

    A figure is None if the run ended too early for it.
    """

    motion: str
    controller: str
    done: float  # Share of the motion's ticks that were run; less than 1 if the controller was too slow.
    ticks: int = 0  # Number of measured ticks.
    failures: int = 0  # Number of measured ticks with an exception, no solution, or numbers that are not finite.
    # Errors are distances between tools and targets. rms_error_mm and max_error_mm do not count the rest at the end.
    rms_error_mm: float | None = None  # RMS error of the tool whose RMS error is larger.
    max_error_mm: float | None = None  # Largest error of either tool.
    end_error_mm: float | None = None  # Error in the last tick, of the tool whose error is larger.
    # Time from the beginning of the motion until both tools stay within 10 mm of the goal. None if they do not stay
    # there until the end, or if the motion has no goal.
    arrival_s: float | None = None
    fallback_percent: float | None = None  # Percentage of ticks with a certified stop; None for a peer.
    min_distance_mm: float | None = None  # Least distance of the monitored pairs, computed by Coal.
    closest_pair: tuple[str, str] | None = None
    max_acceleration: float | None = None  # Largest acceleration of a joint [rad/s^2].
    rest_acceleration: float | None = None  # See :func:`rest_acceleration` [rad/s^2].
    times_us: tuple[float, float, float] | None = None  # Median, p99 and maximum of the computing time of a tick.


@dataclass(frozen=True, slots=True)
class MotionRun:
    """The recorded ticks of a run. The ticks of the approach come first."""

    times: Array  # (n,) The computing times [s].
    q: Array  # (n, nv) The positions that the controller returned [rad].
    v: Array  # (n, nv) The velocities that the controller returned [rad/s].
    asked: list[dict[str, pin.SE3]]  # The targets of each tick, by arm.
    failed: Array  # (n,) bool, True if the tick had no usable solution.


def run_motion(
    controller: BenchController, robot: Robot, motion: WorkMotion, patience: float = math.inf, dt: float = DT
) -> MotionFigures:
    """Run ``motion`` from home in ticks of ``dt`` [s]; see :func:`play_motion` and :func:`figures_of`."""
    return figures_of(play_motion(controller, robot, motion, patience, dt), controller, robot, motion, dt)


def play_motion(controller: BenchController, robot: Robot, motion: WorkMotion, patience: float, dt: float) -> MotionRun:
    """Run ``motion`` from home in ticks of ``dt`` [s]. In a tick without a solution, the arms stay where they are.

    The run ends early if the process has computed for longer than ``patience`` times the motion's duration.
    """
    start = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    asked = [motion.targets(tick * dt, start) for tick in range(round(motion.ends / dt))]
    times, failed = np.empty(len(asked)), np.zeros(len(asked), dtype=bool)
    q, v = np.empty((len(asked), robot.model.nv)), np.empty((len(asked), robot.model.nv))
    done, deadline = 0, time.process_time() + patience * motion.ends
    controller.reset(robot.home)
    gc.collect()
    gc.disable()
    try:
        while done < len(asked) and time.process_time() <= deadline:
            began = time.perf_counter()
            try:
                q[done], v[done] = controller.step(asked[done], dt)
                solved = True
            except Exception:  # Each peer has its own exceptions.
                solved = False
            times[done] = time.perf_counter() - began
            if not (solved and np.isfinite(np.sum(q[done]) + np.sum(v[done]))):
                failed[done] = True
                q[done], v[done] = controller.hold()
            done += 1
    finally:
        gc.enable()
    return MotionRun(times[:done], q[:done], v[:done], asked[:done], failed[:done])


def figures_of(
    run: MotionRun, controller: BenchController, robot: Robot, motion: WorkMotion, dt: float
) -> MotionFigures:
    """Return the figures of the ticks after the approach.

    The monitored pairs of ``robot`` are measured, even if the controller has a robot with other pairs. The arms of
    ``robot`` have to be called left and right.
    """
    began, rests, ends = (round(time / dt) for time in (motion.begins, motion.rests, motion.ends))
    ticks, finished = len(run.q), len(run.q) == ends
    if ticks <= began + 1:
        return MotionFigures(motion.name, controller.name, ticks / ends)
    errors, to_goal = _errors(run, robot, motion, began)
    nearest, pair = nearest_pair(run.q[began:], robot)
    moving = errors[: rests - began]
    stopped = controller.stopped[began:] if isinstance(controller, OwnController) else None
    a = np.diff(run.v, axis=0)[began:] / dt
    median, p99, longest = (1e6 * np.percentile(run.times[began:], (50, 99, 100))).tolist()
    return MotionFigures(
        motion=motion.name,
        controller=controller.name,
        done=ticks / ends,
        ticks=ticks - began,
        failures=int(run.failed[began:].sum()),
        rms_error_mm=1e3 * float(np.sqrt(np.mean(moving**2, axis=0)).max()),
        max_error_mm=1e3 * float(moving.max()),
        end_error_mm=1e3 * float(errors[-1].max()) if finished else None,
        arrival_s=arrival_time(to_goal, dt) if finished and motion.has_goal else None,
        fallback_percent=None if stopped is None else 100.0 * sum(stopped) / len(stopped),
        min_distance_mm=nearest,
        closest_pair=pair,
        max_acceleration=float(np.abs(a).max()),
        rest_acceleration=rest_acceleration(run.v, dt) if finished else None,
        times_us=(median, p99, longest),
    )


def _errors(run: MotionRun, robot: Robot, motion: WorkMotion, began: int) -> tuple[Array, Array]:
    """Return two arrays (n, arms) for the n ticks from ``began`` on [m].

    The first array has the tools' distances from their targets. The second array has their distances from their goals,
    which are the last targets.
    """
    start = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    goal = motion.targets(motion.ends, start)
    tools = np.array([[robot.tool_pose(q, arm).translation for arm in goal] for q in run.q[began:]])
    asked = np.array([[pose.translation for pose in targets.values()] for targets in run.asked[began:]])
    last = np.array([pose.translation for pose in goal.values()])
    return np.linalg.norm(tools - asked, axis=2), np.linalg.norm(tools - last, axis=2)


def arrival_time(to_goal: Array, dt: float) -> float | None:
    """Return the time after which both tools stay at their goals [s]; None if a tool is not there at the end.

    ``to_goal`` (n, arms) are the tools' distances from their goals [m], in ticks of ``dt`` [s].
    """
    away = np.flatnonzero((to_goal >= ARRIVED).any(axis=1))
    first = int(away[-1]) + 1 if len(away) else 0
    return first * dt if first < len(to_goal) else None


def nearest_pair(q: Array, robot: Robot) -> tuple[float | None, tuple[str, str] | None]:
    """Return the least distance of any monitored pair over the postures ``q`` (n, nv) [mm], and the names of the pair.

    Both are None if no pair is monitored. At first, only every fourth posture is measured. Then all postures around the
    posture with the least distance are measured.
    """
    if not len(robot.collision_model.collisionPairs):
        return None, None
    coarse = range(0, len(q), _DISTANCE_TICKS)
    middle = min(coarse, key=lambda tick: robot.distance_values(q[tick]).min())
    fine = range(max(middle - _DISTANCE_TICKS, 0), min(middle + _DISTANCE_TICKS + 1, len(q)))
    pairs = [min(robot.distances(q[tick]), key=lambda pair: pair.distance) for tick in fine]
    found = min(pairs, key=lambda pair: pair.distance)
    return 1e3 * found.distance, (found.name_a, found.name_b)


@dataclass(frozen=True, slots=True)
class BenchRow:
    """The figures of all controllers in one motion. Only our controller also runs in free air."""

    motion: str
    about: str
    reachable: bool  # Whether both arms can reach all targets with every distance kept.
    free_air: MotionFigures
    figures: list[MotionFigures]  # The figures of our controller come first.


@dataclass(frozen=True, slots=True)
class BenchReport:
    """The figures of all motions in one cell."""

    cell: str
    pairs: int
    rounds: int
    rows: list[BenchRow]
    notes: list[str]  # The limitations of the peers, and the peers that are not installed.


def run_bench(
    config: Config, motions: Sequence[WorkMotion], peers: Sequence[str], rounds: int, progress: Callable[[str], None]
) -> BenchReport:
    """Run ``motions`` with our controller and with those ``peers`` that are installed.

    The ``motions`` have to be made for the cell ``config``, such as ``config/dual_iiwa7.yaml``. The speed of a machine
    varies, so the controllers run one after the other, and this is repeated for ``rounds`` rounds. Computing times are
    the medians over the rounds. All other figures come from the last round.
    """
    robot = Robot.from_config(config)
    free = OwnController(without_pairs(config), config, "free air")
    others, notes = build_peers(peers, PeerSettings(robot, config, DT))
    ahead = [Leading(peer, config.control.position_gain) for peer in others]
    controllers: list[BenchController] = [free, OwnController(robot, config), *ahead]
    rows = []
    for number, motion in enumerate(motions, 1):
        runs: dict[str, list[MotionFigures]] = {controller.name: [] for controller in controllers}
        for turn in range(rounds):
            for controller in controllers:
                progress(f"{motion.name} ({number} of {len(motions)}), round {turn + 1}, {controller.name}")
                runs[controller.name].append(run_motion(controller, robot, motion, PATIENCE))
        figures = [_over_rounds(found) for found in runs.values()]
        rows.append(BenchRow(motion.name, motion.about, motion.reachable, figures[0], figures[1:]))
    return BenchReport(config.name, len(robot.collision_model.collisionPairs), rounds, rows, notes)


def _over_rounds(runs: Sequence[MotionFigures]) -> MotionFigures:
    """Return the figures of the last round, but with the medians of the computing times over all rounds."""
    times = [run.times_us for run in runs if run.times_us is not None]
    if not times:
        return runs[-1]
    median, p99, longest = np.median(times, axis=0).tolist()
    return replace(runs[-1], times_us=(median, p99, longest))
