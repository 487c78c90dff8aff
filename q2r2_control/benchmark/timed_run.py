"""One timed run of a controller, our own or a peer, and the same metrics of its motion for all."""

from __future__ import annotations

import gc
import math
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.motion_measures import rest_acceleration
from q2r2_control.benchmark.peers.base import BenchController
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

Poses = dict[str, pin.SE3]
Targets = Callable[[float, Poses], Poses]

WARM_UP = 0.1  # share of the ticks that is not counted in times
_SHORTEST_DT = 1e-9  # a tick that moves nothing [s]


@dataclass(frozen=True, slots=True)
class RunMetrics:
    """Metrics of the motion of a run, warm-up included."""

    max_acceleration_ratio: float  # change of velocity in a tick, to our limit
    max_velocity_ratio: float
    min_position_margin_rad: float  # beyond the configured margin
    min_distance_mm: float  # of the monitored pairs, by Coal
    failures: int  # ticks: exception, no solution, not finite
    tail_acceleration: float  # RMS over the last 0.5 s, norm over the joints [rad/s^2]
    position_error_mm: float  # of the tool that is farther from its target at the end


@dataclass(frozen=True, slots=True)
class TimedRun:
    """Times of the ticks after the warm-up, and the motion of all ticks."""

    times_us: Array  # (ticks,)
    q: Array  # (n, nv) [rad]
    v: Array  # (n, nv) [rad/s]
    asked: list[Poses]  # n
    failed: Array  # (n,) bool
    dt: float  # [s]

    @property
    def failures(self) -> int:
        """Ticks without a solution."""
        return int(self.failed.sum())


class OwnController:
    """:class:`CartesianController` in the bench: the full tick, certificate and report included."""

    name = "q2r2_control"
    limitations = ""

    def __init__(self, controller: CartesianController) -> None:
        self._controller = controller
        self.stopped: list[bool] = []  # of each tick since the reset: whether the certified stop was executed

    @property
    def fallbacks(self) -> int:
        """Ticks since the reset in which the certified stop was executed."""
        return sum(self.stopped)

    def reset(self, q: Array) -> None:
        """See :class:`BenchController`."""
        self._controller.reset(q)
        self.stopped.clear()

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        reference = self._controller.step(targets, dt)
        self.stopped.append(reference.report.fallback)
        return reference.q, reference.v

    def hold(self) -> tuple[Array, Array]:
        """See :class:`BenchController`; only called after a step that raised, which the contract forbids."""
        reference = self._controller.step({}, _SHORTEST_DT)
        return reference.q, np.zeros_like(reference.v)


def timed_run(
    controller: BenchController,
    robot: Robot,
    targets: Targets,
    ticks: int,
    dt: float,
    *,
    warm_up: int | None = None,
    patience: float = math.inf,
) -> TimedRun:
    """Run from home for ``warm_up`` ticks of ``dt`` [s], a tenth of ``ticks`` by default, and ``ticks`` that are timed.

    A run that has taken longer than ``patience`` [s], of this process alone, is left as it is, with fewer ticks.
    """
    untimed = int(WARM_UP * ticks) if warm_up is None else warm_up
    start = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    asked = [targets(tick * dt, start) for tick in range(untimed + ticks)]
    times, failed = np.empty(len(asked)), np.zeros(len(asked), dtype=bool)
    q, v = np.empty((len(asked), robot.model.nv)), np.empty((len(asked), robot.model.nv))
    done, deadline = 0, time.process_time() + patience
    controller.reset(robot.home)
    gc.collect()
    gc.disable()
    try:
        while done < len(asked) and time.process_time() <= deadline:
            began = time.perf_counter()
            try:
                q[done], v[done] = controller.step(asked[done], dt)
                solved = True
            except Exception:  # each peer has exceptions of its own
                solved = False
            times[done] = time.perf_counter() - began
            if not (solved and np.isfinite(np.sum(q[done]) + np.sum(v[done]))):
                failed[done] = True
                q[done], v[done] = controller.hold()
            done += 1
    finally:
        gc.enable()
    return TimedRun(1e6 * times[untimed:done], q[:done], v[:done], asked[:done], failed[:done], dt)


def metrics_of(run: TimedRun, robot: Robot, settings: ControllerSettings) -> RunMetrics:
    """Metrics of a run, computed in the same way for all controllers."""
    q, v = run.q, run.v
    a = np.diff(v, axis=0, prepend=0.0) / run.dt
    room = np.minimum(q - robot.position_lower, robot.position_upper - q) - settings.position_margin
    errors = [
        np.linalg.norm(robot.tool_pose(q[-1], arm).translation - pose.translation)
        for arm, pose in run.asked[-1].items()
    ]
    return RunMetrics(
        max_acceleration_ratio=float((np.abs(a) / robot.capped_acceleration(settings.acceleration_limit)).max()),
        max_velocity_ratio=float((np.abs(v) / (robot.velocity_limit * settings.velocity_scale)).max()),
        min_position_margin_rad=float(room.min()),
        min_distance_mm=1e3 * min(float(robot.distance_values(posture).min(initial=np.inf)) for posture in q),
        failures=run.failures,
        tail_acceleration=rest_acceleration(v, run.dt),
        position_error_mm=1e3 * float(max(errors)),
    )
