"""How long one full tick of the controller takes: both arms, every pair, certificate and report."""

from __future__ import annotations

import gc
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import ConfigError
from q2r2_control.robot.robot import Robot

Poses = dict[str, pin.SE3]
_DT = 0.001  # [s]
_WARM_UP = 0.1  # share of the ticks that is not counted


@dataclass(frozen=True, slots=True)
class BenchRow:
    """One scenario; times of :meth:`CartesianController.step` alone."""

    name: str
    ticks: int
    median_us: float
    p99_us: float
    max_us: float
    min_distance_mm: float
    max_acceleration_ratio: float
    fallback_ticks: int


@dataclass(frozen=True, slots=True)
class BenchReport:
    """All scenarios on one cell."""

    cell: str
    pairs: int
    rows: list[BenchRow]

    def as_json(self) -> dict[str, Any]:
        """Plain data for ``json.dumps``."""
        return asdict(self)


def run_bench(config: Config, ticks: int) -> BenchReport:
    """Time ``ticks`` ticks of 1 ms of each scenario. Raises :class:`ConfigError` for fewer than 100."""
    if ticks < 100:
        raise ConfigError(f"bench: ticks = {ticks}: allowed: 100 or more")
    robot = Robot.from_config(config)
    # What is late depends on the machine that is being measured.
    controller = CartesianController(robot, config.control.model_copy(update={"solve_time_limit": None}))
    scenarios = {"free motion": _circle, "contact": _crossing}
    rows = [_measure(name, controller, targets, ticks) for name, targets in scenarios.items()]
    return BenchReport(config.name, len(robot.collision_model.collisionPairs), rows)


def _circle(t: float, start: Poses) -> Poses:
    """Circles of 0.1 m in the air, one in two seconds."""
    phase = np.pi * t
    by = np.array([0.0, 0.1 * np.sin(phase), 0.1 * (1.0 - np.cos(phase))])
    return {arm: pin.SE3(pose.rotation, pose.translation + by) for arm, pose in start.items()}


def _crossing(t: float, start: Poses) -> Poses:
    """Every tool is asked to be where another one started: the arms press against each other."""
    arms = list(start)
    return {arm: start[other] for arm, other in zip(arms, arms[1:] + arms[:1], strict=True)}


def _measure(
    name: str, controller: CartesianController, targets: Callable[[float, Poses], Poses], ticks: int
) -> BenchRow:
    robot = controller.robot
    controller.reset(robot.home)
    start = {arm: controller.tool_pose(arm) for arm in robot.arms}
    warm_up = int(_WARM_UP * ticks)
    times = np.empty(warm_up + ticks)
    distance, acceleration, fallbacks = float("inf"), 0.0, 0
    gc.collect()
    gc.disable()
    try:
        for tick in range(len(times)):
            goal = targets(tick * _DT, start)
            began = time.perf_counter()
            reference = controller.step(goal, _DT)
            times[tick] = time.perf_counter() - began
            distance = min(distance, reference.report.closest_distance)
            acceleration = max(acceleration, float(np.abs(reference.a).max()))
            fallbacks += reference.report.fallback
    finally:
        gc.enable()
    times = times[warm_up:]
    return BenchRow(
        name=name,
        ticks=ticks,
        median_us=1e6 * float(np.median(times)),
        p99_us=1e6 * float(np.percentile(times, 99)),
        max_us=1e6 * float(times.max()),
        min_distance_mm=1e3 * distance,
        max_acceleration_ratio=acceleration / controller.settings.acceleration_limit,
        fallback_ticks=fallbacks,
    )
