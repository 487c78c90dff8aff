"""Run one controller in one work motion and compute its figures, and run the bench of our controller and its peers.

All controllers get the same cell, limits, targets and ticks, in one process. Peers run open loop like our controller,
and their targets are moved ahead of time by their lag. Our controller also runs in free air. The difference between
its two runs is the cost of the monitored pairs.
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

DT = 0.001  # [s]
ARRIVED = 0.01  # A tool within this distance of its goal has arrived [m].
PATIENCE = 3.0  # Longest time that a controller may take, as a multiple of the motion's own time.
JOLT = 5.0  # A larger change of a joint's acceleration in one tick is a jolt [rad/s^2].
_TAIL = 0.5  # Duration at the end over which the acceleration at rest is computed [s].
_SHORTEST_DT = 1e-9  # Duration of a tick that moves nothing [s].
# Distances are measured at one posture in so many ticks. Around the nearest of these postures, all are measured.
_DISTANCE_TICKS = 4


class OwnController:
    """:class:`CartesianController` as a :class:`BenchController`.

    It has the settings of a cell without the time limit, so that a slow machine computes the same motion.
    """

    limitations = ""

    def __init__(self, robot: Robot, config: Config, name: str = "q2r2_control") -> None:
        self.name = name
        self._controller = CartesianController(robot, config.control.timed(realtime=False))
        # For each tick since the reset, whether the certified stop was executed, and whether some QP was not solved.
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
        """Return the same positions at rest. This follows only a step that raised, which the contract forbids."""
        reference = self._controller.step({}, _SHORTEST_DT)
        return reference.q, np.zeros_like(reference.v)


def without_pairs(config: Config) -> Robot:
    """Return the robot of a cell in free air: no pair is monitored, so that the arms can move through everything."""
    robot = Robot.from_config(config)
    robot.collision_model.removeAllCollisionPairs()
    return robot


def rest_acceleration(v: Array, dt: float) -> float:
    """Return the RMS of the acceleration's norm over the joints [rad/s^2] in the last 0.5 s.

    ``v`` (n, nv) are the velocities [rad/s].
    """
    a = np.diff(v, axis=0, prepend=0.0)[-round(_TAIL / dt) :] / dt
    return float(np.sqrt(np.mean(np.sum(a**2, axis=1))))


def count_jolts(v: Array, dt: float, since: float) -> int:
    """Count the ticks after ``since`` [s] in which an acceleration changes by more than :data:`JOLT`.

    ``v`` (n, nv) are the velocities [rad/s].
    """
    a = np.diff(v, axis=0, prepend=0.0) / dt
    changes = np.abs(np.diff(a, axis=0)).max(axis=1)
    return int((changes[round(since / dt) :] > JOLT).sum())


@dataclass(frozen=True, slots=True)
class MotionFigures:
    """Figures of one controller in one motion after the approach. A figure is None if the run ended before it."""

    motion: str
    controller: str
    done: float  # Share of the ticks; less than 1 if the controller was too slow.
    ticks: int = 0  # Measured ticks.
    failures: int = 0  # Measured ticks with an exception, no solution, or numbers that are not finite.
    rms_error_mm: float | None = None  # RMS error of the tool with the larger error, until the rest begins.
    max_error_mm: float | None = None  # Largest error of either tool until the rest begins.
    end_error_mm: float | None = None  # Largest error of either tool at the end.
    # Time from the beginning of the motion until both tools stay within 10 mm of the goal. None if they do not stay
    # there until the end, or if the motion has no goal.
    arrival_s: float | None = None
    fallback_percent: float | None = None  # Share of ticks with the certified stop; None for a peer, which has none.
    min_distance_mm: float | None = None  # Least distance of the monitored pairs, by Coal.
    closest_pair: tuple[str, str] | None = None
    max_acceleration: float | None = None  # Largest acceleration of a joint [rad/s^2].
    rest_acceleration: float | None = None  # See :func:`rest_acceleration` [rad/s^2].
    times_us: tuple[float, float, float] | None = None  # Median, p99 and maximum of a tick.


@dataclass(frozen=True, slots=True)
class MotionRun:
    """The recorded ticks of a run. The ticks of the approach come first."""

    times: Array  # (n,) [s]
    q: Array  # (n, nv) [rad]
    v: Array  # (n, nv) [rad/s]
    asked: list[dict[str, pin.SE3]]  # The targets of each tick.
    failed: Array  # (n,) bool, whether the tick had no solution


def run_motion(
    controller: BenchController, robot: Robot, motion: WorkMotion, patience: float = math.inf, dt: float = DT
) -> MotionFigures:
    """Run ``motion`` from home in ticks of ``dt`` [s]; see :func:`play_motion` and :func:`figures_of`."""
    return figures_of(play_motion(controller, robot, motion, patience, dt), controller, robot, motion, dt)


def play_motion(controller: BenchController, robot: Robot, motion: WorkMotion, patience: float, dt: float) -> MotionRun:
    """Run ``motion`` from home. A tick without a solution leaves the arms where they are.

    The run ends early if the process has used ``patience`` times the motion's own time.
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

    ``robot`` defines the measured pairs, and may differ from the controller's. Its arms have to be left and right.
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
    """Return two distances (n, arms) of the tools in the n measured ticks [m]: from their targets, and from the goal.

    The goal is the last target.
    """
    start = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    goal = motion.targets(motion.ends, start)
    tools = np.array([[robot.tool_pose(q, arm).translation for arm in goal] for q in run.q[began:]])
    asked = np.array([[pose.translation for pose in targets.values()] for targets in run.asked[began:]])
    last = np.array([pose.translation for pose in goal.values()])
    return np.linalg.norm(tools - asked, axis=2), np.linalg.norm(tools - last, axis=2)


def arrival_time(to_goal: Array, dt: float) -> float | None:
    """Return the time after which both tools stay at the goal [s]; None if they are not there at the end."""
    away = np.flatnonzero((to_goal >= ARRIVED).any(axis=1))
    first = int(away[-1]) + 1 if len(away) else 0
    return first * dt if first < len(to_goal) else None


def nearest_pair(q: Array, robot: Robot) -> tuple[float | None, tuple[str, str] | None]:
    """Return the least distance [mm] over postures (n, nv), and its pair.

    Every few postures are measured first, then all postures around the nearest one.
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
    """The figures of one motion: of our controller in free air and in the cell, and of the peers in the cell."""

    motion: str
    about: str
    reachable: bool  # Whether both arms can reach all targets with every distance kept.
    free_air: MotionFigures
    figures: list[MotionFigures]  # Ours comes first.


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
    """Run ``motions``, which are made for ``config/dual_iiwa7.yaml``, with our controller and installed ``peers``.

    All controllers take turns for ``rounds`` rounds, because the speed of a machine varies. Figures are those of the
    last round. Times are the medians over the rounds.
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
    """Return the figures of the last round, with the medians of all times."""
    times = [run.times_us for run in runs if run.times_us is not None]
    if not times:
        return runs[-1]
    median, p99, longest = np.median(times, axis=0).tolist()
    return replace(runs[-1], times_us=(median, p99, longest))
