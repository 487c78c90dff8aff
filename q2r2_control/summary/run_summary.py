"""Summary of a run: figures gathered at every tick, in constant memory and in a few microseconds."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.events import Event
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.histogram import NOTHING_MEASURED, Histogram, Percentiles
from q2r2_control.summary.joint_extremes import JointExtremes
from q2r2_control.summary.tick import Tick
from q2r2_control.summary.torque_summary import TorqueStatistics, TorqueSummary
from q2r2_control.types import ArmTarget, Array, HandSample
from q2r2_control.wording import sentence

EVENTS_KEPT = 10_000  # the newest ones; a broken button can cause more
_REST = 1e-3  # [rad/s]
# Ticks wait for as many: counted one after the other each takes a third of the time, since the first warms the caches.
_BATCH = 16


@dataclass(frozen=True, slots=True)
class ArmSummary:
    """One arm, over the ticks in which it was engaged.

    Errors are between the measured tool and the operator's target. They include lag, limits, the other arm, and how far
    the tool yields to a push, by impedance or by admittance.
    """

    engaged_s: float
    position_error_mm_rms: float | None  # None: never engaged
    rotation_error_deg_rms: float | None
    gripper_changes: int
    gripper_held_s: float  # for which something near its fingers kept it from opening or closing as wanted
    gripper_held_by: tuple[str, str] | None  # geometry names of the last pair that did
    object_held_s: float | None  # for which its gripper held its object; None: the cell's YAML has none for it
    slip_mm_max: float  # largest slip of one engagement: how far the leash moved the target
    slip_deg_max: float
    yielded_mm_max: float  # largest displacement of the target by the admittance, in position mode
    yielded_deg_max: float


@dataclass(frozen=True, slots=True)
class RunSummary:
    """A whole run. Ratios and margins are the worst of all ticks; 1 is the limit."""

    ticks: int
    duration_s: float
    loop_rate_hz: float
    tick_us: Percentiles  # from polling the input to the command, plant not included
    lateness_us: Percentiles  # of a tick's begin, after it was due; None in simulated time
    input_to_command_ms: Percentiles  # from a sample's receipt to the command it led to
    arms: dict[str, ArmSummary]
    min_distance_mm: float | None  # None: no monitored pair
    closest_pair: tuple[str, str] | None
    max_velocity_ratio: float
    max_acceleration_ratio: float
    min_position_margin_rad: float  # beyond the configured margin
    fallback_ticks: int
    uncertified_ticks: int
    rejected_targets: int
    overruns: int  # ticks that began more than a period after they were due
    missed_ticks: int  # that were due and did not come, since the loop was late
    stretched_s: float  # by how much that made the motion late
    at_rest: bool  # the reference was at rest when the run ended
    torque: TorqueSummary | None  # None: position mode
    events: list[Event]

    def as_json(self) -> dict[str, Any]:
        """Data for ``json.dumps``."""
        data = asdict(self)
        data["events"] = [event.as_json() | {"reason": sentence(event.reason)} for event in self.events]
        return data


@dataclass(slots=True)
class _ArmFigures:
    engaged: float = 0.0
    ticks: int = 0
    position: float = 0.0  # sum of squares [m^2]
    rotation: float = 0.0  # [rad^2]
    gripper: float | None = None
    gripper_changes: int = 0
    held: float = 0.0  # [s]
    held_by: tuple[str, str] | None = None
    object_held: float | None = None  # [s]
    slip: float = 0.0  # largest [m]
    slip_angle: float = 0.0  # largest [rad]
    yielded: float = 0.0  # largest [m]
    yielded_angle: float = 0.0  # largest [rad]

    def count(self, name: str, tick: Tick) -> None:
        """Add one tick of the arm ``name``."""
        if (target := tick.targets.get(name)) is not None:
            self._count_target(name, target, tick)
        if (pair := tick.held_grippers.get(name)) is not None:
            self.held += tick.dt
            self.held_by = pair
        if (holds := tick.holding.get(name)) is not None:
            self.object_held = (self.object_held or 0.0) + (tick.dt if holds else 0.0)
        if tick.admittance is not None:
            displacement = tick.admittance.arms[name].displacement
            self.yielded = max(self.yielded, math.hypot(*displacement[:3]))
            self.yielded_angle = max(self.yielded_angle, math.hypot(*displacement[3:]))

    def _count_target(self, name: str, target: ArmTarget, tick: Tick) -> None:
        if self.gripper != target.gripper:
            self.gripper_changes += self.gripper is not None
            self.gripper = target.gripper
        self.slip = max(self.slip, target.slip)
        self.slip_angle = max(self.slip_angle, target.slip_angle)
        if target.pose is not None and tick.engaged[name]:
            self.engaged += tick.dt
            position, rotation = _error(pin.SE3ToXYZQUATtuple(tick.tools[name]), pin.SE3ToXYZQUATtuple(target.pose))
            if math.isfinite(position + rotation):  # else nothing was measured
                self.ticks += 1
                self.position += position
                self.rotation += rotation


@dataclass(slots=True)
class RunStatistics:
    """Gathers a :class:`RunSummary`."""

    robot: Robot
    control: ControllerSettings
    compute_times: Histogram = field(default_factory=lambda: Histogram(1e-3))
    latency: Histogram = field(default_factory=lambda: Histogram(1e-3))
    events: deque[Event] = field(default_factory=lambda: deque(maxlen=EVENTS_KEPT))
    _arms: dict[str, _ArmFigures] = field(init=False)
    _torque: TorqueStatistics = field(init=False)
    _extremes: JointExtremes = field(init=False)
    _ticks: int = 0
    _duration: float = 0.0
    _distance: float = float("inf")
    _pair: tuple[str, str] | None = None
    _fallback: int = 0
    _uncertified: int = 0
    _rejected: int = 0
    _newest_v: Array | None = None
    _waiting: list[Tick] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._arms = {name: _ArmFigures() for name in self.robot.arms}
        self._torque = TorqueStatistics.of(tuple(self.robot.arms))
        self._extremes = JointExtremes(self.robot, self.control)

    def add(self, tick: Tick) -> None:
        """Count one tick, which nobody may change any more."""
        self._newest_v = tick.reference.v
        self.compute_times.add(tick.compute_time)
        self.events.extend(tick.events)
        self._waiting.append(tick)
        if len(self._waiting) == _BATCH:
            self._count_waiting()

    def _count_waiting(self) -> None:
        for tick in self._waiting:
            self._count(tick)
        self._waiting.clear()

    def _count(self, tick: Tick) -> None:
        report = tick.reference.report
        self._ticks += 1
        self._duration += tick.dt
        self._extremes.add(tick.reference)
        if report.closest_distance < self._distance:
            self._distance, self._pair = report.closest_distance, report.closest_pair
        self._fallback += report.fallback
        self._uncertified += not report.certified
        self._rejected += len(report.rejected)
        for name, figures in self._arms.items():
            figures.count(name, tick)
        if tick.impedance is not None and tick.wall is not None:
            self._torque.add(tick.dt, tick.impedance, tick.wall)

    def add_latency(self, samples: list[HandSample], now: float) -> None:
        """Count the time from the receipt of a tick's newest sample to its command, sent at ``now`` [s]."""
        if samples:
            self.latency.add(now - max(max(sample.pose_stamp, sample.inputs_stamp) for sample in samples))

    def summary(
        self,
        wall_time: float,
        missed_ticks: int = 0,
        stretched: float = 0.0,
        lateness: Percentiles = NOTHING_MEASURED,
        overruns: int = 0,
    ) -> RunSummary:
        """The run so far.

        ``wall_time`` and ``stretched`` [s] are what it took and how late the motion is; ``lateness`` [ms] and
        ``overruns``: see :class:`LoopClock`.
        """
        self._count_waiting()
        return RunSummary(
            ticks=self._ticks,
            duration_s=self._duration,
            loop_rate_hz=self._ticks / wall_time if wall_time > 0 else 0.0,
            tick_us=self.compute_times.percentiles().scaled(1e3),
            lateness_us=lateness.scaled(1e3),
            input_to_command_ms=self.latency.percentiles(),
            arms={name: _arm_summary(figures) for name, figures in self._arms.items()},
            min_distance_mm=1e3 * self._distance if self._pair else None,
            closest_pair=self._pair,
            max_velocity_ratio=self._extremes.velocity_ratio,
            max_acceleration_ratio=self._extremes.acceleration_ratio,
            min_position_margin_rad=self._extremes.position_margin if self._ticks else 0.0,
            fallback_ticks=self._fallback,
            uncertified_ticks=self._uncertified,
            rejected_targets=self._rejected,
            overruns=overruns,
            missed_ticks=missed_ticks,
            stretched_s=stretched,
            at_rest=self._newest_v is None or bool(np.abs(self._newest_v).max() < _REST),
            torque=self._torque.summary(),
            events=list(self.events),
        )


def _error(tool: tuple[float, ...], target: tuple[float, ...]) -> tuple[float, float]:
    """Squares of distance [m^2] and angle [rad^2] between two poses, as floats, quaternions x y z w."""
    x, y, z, a, b, c, w = tool
    to_x, to_y, to_z, to_a, to_b, to_c, to_w = target
    dx, dy, dz = to_x - x, to_y - y, to_z - z
    half = math.acos(min(abs(a * to_a + b * to_b + c * to_c + w * to_w), 1.0))  # to 1e-7 rad; what is no number stays
    return dx * dx + dy * dy + dz * dz, 4.0 * half * half


def _arm_summary(figures: _ArmFigures) -> ArmSummary:
    rms = [
        None if not figures.ticks else (total / figures.ticks) ** 0.5 for total in (figures.position, figures.rotation)
    ]
    return ArmSummary(
        engaged_s=figures.engaged,
        position_error_mm_rms=None if rms[0] is None else 1e3 * rms[0],
        rotation_error_deg_rms=None if rms[1] is None else float(np.degrees(rms[1])),
        gripper_changes=figures.gripper_changes,
        gripper_held_s=figures.held,
        gripper_held_by=figures.held_by,
        object_held_s=figures.object_held,
        slip_mm_max=1e3 * figures.slip,
        slip_deg_max=math.degrees(figures.slip_angle),
        yielded_mm_max=1e3 * figures.yielded,
        yielded_deg_max=math.degrees(figures.yielded_angle),
    )
