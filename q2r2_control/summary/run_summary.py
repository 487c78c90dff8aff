"""Summarise a run by figures that are collected at every tick, in constant memory."""

from __future__ import annotations

import math
from array import array
from collections import deque
from dataclasses import asdict, dataclass, field, replace
from typing import Any

import numpy as np

from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.config.control import ControllerSettings
from q2r2_control.events import CommonReason, Event
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.teleop.reasons import TeleopReason
from q2r2_control.types import ArmTarget, HandSample
from q2r2_control.wording import sentence

_BINS = 100_000
EVENTS_KEPT = 10_000  # Only this number of the newest events is kept, because a broken button can cause far more.
_FOLLOWED = 100.0  # Distance up to which the impedance pushes back with a growing force [mm].
_REST = 1e-3  # The reference is at rest if no joint is faster [rad/s].


@dataclass(frozen=True, slots=True)
class Percentiles:
    """Percentiles of a duration, or None if nothing was measured.

    p50 and p99 are exact to 1/1000 of the histogram's unit.
    """

    p50: float | None
    p99: float | None
    max: float | None


NOTHING_MEASURED = Percentiles(None, None, None)


class Histogram:
    """Counts durations with a resolution of ``unit`` / 1000 [s], up to 100 units."""

    def __init__(self, unit: float) -> None:
        self._bin = unit * 1e-3
        self._counts = array("q", bytes(8 * _BINS))
        self._largest = 0.0

    def add(self, duration: float) -> None:
        """Count one duration [s]. A negative duration counts as zero. A duration that is not finite does not count."""
        if math.isfinite(duration):
            self._counts[int(min(max(duration / self._bin, 0.0), _BINS - 1))] += 1
            self._largest = max(self._largest, duration)

    def percentiles(self, unit: float) -> Percentiles:
        """Return the percentiles in multiples of ``unit`` [s]."""
        cumulative = np.cumsum(self._counts)
        if not cumulative[-1]:
            return NOTHING_MEASURED
        bins = (int(np.searchsorted(cumulative, share * cumulative[-1])) for share in (0.5, 0.99))
        values = (math.inf if index == _BINS - 1 else (index + 1) * self._bin for index in bins)
        middle, high = (min(value, self._largest) / unit for value in values)
        return Percentiles(middle, high, self._largest / unit)


@dataclass(slots=True)
class TorqueSummary:
    """Figures of a run in torque mode."""

    # For each arm, the time for which its distance from the reference was larger than the impedance's error clip.
    off_reference_s: dict[str, float]
    # Least distance of a monitored pair at the measured joint positions; None if there is no monitored pair.
    min_measured_distance_mm: float | None = None
    measured_closest_pair: tuple[str, str] | None = None
    pressed_pairs: list[tuple[str, str]] = field(default_factory=list)  # Pairs that the wall has pushed apart.
    max_wall_force_n: float = 0.0  # The greatest force of the wall on one pair.
    saturated_ticks: int = 0  # Ticks in which a joint would have needed more torque than its limit.
    rate_limited_ticks: int = 0  # Ticks in which the rate limit slowed the change of a joint's torque.
    held_ticks: int = 0  # Ticks without a usable measurement, in which the last gravity torque was held.

    @property
    def met(self) -> bool:
        """Whether two links that must not touch have touched, by the measured joint positions."""
        return (self.min_measured_distance_mm or 0.0) < 0.0

    def add(self, dt: float, impedance: ImpedanceReport, wall: WallReport) -> None:
        """Count one tick of ``dt`` [s]."""
        least = math.inf if self.min_measured_distance_mm is None else self.min_measured_distance_mm
        # The distance is NaN if nothing was measured. The comparison is then False, so the smallest distance stays.
        # ``held_ticks`` counts such ticks.
        if 1e3 * wall.closest_distance < least:
            self.min_measured_distance_mm = 1e3 * wall.closest_distance
            self.measured_closest_pair = wall.closest_pair
        if wall.pressing:
            self.pressed_pairs = sorted({*self.pressed_pairs, *wall.pressing})
        self.max_wall_force_n = max(self.max_wall_force_n, wall.force)
        self.saturated_ticks += bool(impedance.saturated)
        self.rate_limited_ticks += bool(impedance.rate_limited)
        self.held_ticks += impedance.held
        for arm in impedance.clipped:
            self.off_reference_s[arm] += dt


@dataclass(slots=True)
class ArmSummary:
    """Figures of one arm while it was engaged. Errors compare the measured tool with the operator's target."""

    engaged_s: float = 0.0
    position_error_mm_rms: float | None = None  # None if the arm was never engaged.
    rotation_error_deg_rms: float | None = None
    gripper_changes: int = 0
    gripper_held_s: float = 0.0  # Time for which a body near the fingers prevented the wanted opening of the gripper.
    gripper_held_by: tuple[str, str] | None = None  # The pair of geometries that prevented the opening last.
    object_held_s: float | None = None  # Time for which the gripper held its object; None if the arm has no object.
    slip_mm_max: float = 0.0  # Largest slip of the target in one engagement.
    slip_deg_max: float = 0.0
    yielded_mm_max: float = 0.0  # Largest displacement of the target by the admittance, in position mode.
    yielded_deg_max: float = 0.0
    policy_s: float = 0.0  # Time for which a policy moved the arm.
    interventions: int = 0  # Number of times that a hand took over from a policy.
    intervention_s: float = 0.0
    # Distance at the end between the measured tool and the tool at the reference; None if it was not measured.
    end_error_mm: float | None = None

    @property
    def followed(self) -> bool:
        """Whether the tool was within ``_FOLLOWED`` [mm] of its reference at the end; True if it was not measured."""
        return self.end_error_mm is None or self.end_error_mm <= _FOLLOWED


@dataclass(frozen=True, slots=True)
class RunSummary:
    """Figures of a whole run. Ratios and margins are the worst of all ticks. At a ratio of 1, the limit was reached."""

    ticks: int
    duration_s: float
    loop_rate_hz: float
    real_time_factor: float | None  # Simulated seconds per second of the computer's clock; None in real time.
    tick_us: Percentiles  # Time from polling the input to the command, without the plant.
    lateness_us: Percentiles  # Delay of ticks after the times at which they were due; None in simulated time.
    input_to_command_ms: Percentiles  # Time from the receipt of a sample to the command that follows from it.
    arms: dict[str, ArmSummary]
    min_distance_mm: float | None  # Least distance in the reference; None if there is no monitored pair.
    closest_pair: tuple[str, str] | None
    max_velocity_ratio: float
    max_acceleration_ratio: float
    min_position_margin_rad: float  # Least distance of a joint from a position limit, minus the configured margin.
    fallback_ticks: int
    uncertified_ticks: int
    rejected_targets: int
    overruns: int  # Ticks that began more than a period after they were due.
    missed_ticks: int  # Ticks that were due and did not come, because the loop was late.
    stretched_s: float  # Time by which the motion is late because the loop was late.
    at_rest: bool  # Whether the reference was at rest when the run ended.
    torque: TorqueSummary | None  # None in position mode.
    events: list[Event]

    @property
    def broken(self) -> tuple[str, ...]:
        """Broken promises in words. A run with any broken promise ends with exit code 1."""
        refusals = {event.arm: event.reason for event in self.events if event.kind is TeleopReason.NOT_ENGAGED}
        broken = []
        for name, arm in self.arms.items():
            if not arm.followed:
                broken.append(f"{name} arm is {arm.end_error_mm:.0f} mm from its reference at the end")
            if name in refusals and not arm.engaged_s:
                broken.append(f"{name} arm {sentence(refusals[name])}, at every press")
        if self.torque is not None and self.torque.met:
            met = " and ".join(self.torque.measured_closest_pair or ())
            broken.append(f"measured {met} met: {self.torque.min_measured_distance_mm:.1f} mm")
        if self.uncertified_ticks:
            broken.append(f"{self.uncertified_ticks} ticks without a certificate")
        # Both arms report the same error of a policy, so equal errors are named only once.
        roots = (event.reason.root for event in self.events)
        broken += dict.fromkeys(sentence(root) for root in roots if root.kind is CommonReason.POLICY_UNUSABLE)
        if not self.at_rest:
            broken.append("arms move at the end")
        return tuple(broken)

    def as_json(self) -> dict[str, Any]:
        data = asdict(self)
        data["events"] = [event.as_json() | {"reason": sentence(event.reason)} for event in self.events]
        return data


class _ArmStatistics:
    def __init__(self, name: str) -> None:
        self._name = name
        self.summary = ArmSummary()
        self._gripper: float | None = None
        self._intervenes = False
        self._squares, self._ticks = np.zeros(2), 0  # Sums of the squared errors [m^2], [rad^2], and their number.

    def add(self, tick: Tick) -> None:
        name, summary = self._name, self.summary
        if (target := tick.targets.get(name)) is not None:
            self._add_target(target, tick)
        intervenes = tick.interventions.get(name, False)
        summary.interventions += intervenes and not self._intervenes
        summary.intervention_s += tick.dt if intervenes else 0.0
        summary.policy_s += tick.dt if tick.by_policy(name) else 0.0
        self._intervenes = intervenes
        if (pair := tick.held_grippers.get(name)) is not None:
            summary.gripper_held_s += tick.dt
            summary.gripper_held_by = pair
        if (holds := tick.holding.get(name)) is not None:
            summary.object_held_s = (summary.object_held_s or 0.0) + (tick.dt if holds else 0.0)
        if tick.admittance is not None:
            displacement = tick.admittance.arms[name].displacement
            summary.yielded_mm_max = max(summary.yielded_mm_max, 1e3 * math.hypot(*displacement[:3]))
            summary.yielded_deg_max = max(summary.yielded_deg_max, math.degrees(math.hypot(*displacement[3:])))

    def _add_target(self, target: ArmTarget, tick: Tick) -> None:
        summary = self.summary
        if self._gripper != target.gripper:
            summary.gripper_changes += self._gripper is not None
            self._gripper = target.gripper
        if target.slip > 0.0 or target.slip_angle > 0.0:
            summary.slip_mm_max = max(summary.slip_mm_max, 1e3 * target.slip)
            summary.slip_deg_max = max(summary.slip_deg_max, math.degrees(target.slip_angle))
        if target.pose is not None and tick.engaged[self._name]:
            summary.engaged_s += tick.dt
            errors = tick.tracking_error(self._name)
            if math.isfinite(sum(errors)):  # If a value is not finite, nothing was measured.
                self._ticks += 1
                self._squares += np.square(errors)

    def finished(self) -> ArmSummary:
        if not self._ticks:
            return self.summary
        position, rotation = np.sqrt(self._squares / self._ticks) * (1e3, math.degrees(1.0))
        return replace(self.summary, position_error_mm_rms=float(position), rotation_error_deg_rms=float(rotation))


class RunStatistics:
    """Collects the figures of a :class:`RunSummary`."""

    def __init__(self, robot: Robot, control: ControllerSettings) -> None:
        self.robot, self._control = robot, control
        self.events: deque[Event] = deque(maxlen=EVENTS_KEPT)
        self._compute_times, self._latency = Histogram(1e-3), Histogram(1e-3)
        self._arms = {name: _ArmStatistics(name) for name in robot.arms}
        self._torque: TorqueSummary | None = None
        self._speed, self._acceleration = np.zeros(robot.model.nv), np.zeros(robot.model.nv)
        self._lowest, self._highest = np.full(robot.model.nv, np.inf), np.full(robot.model.nv, -np.inf)
        self._newest: Tick | None = None
        self._ticks, self._duration = 0, 0.0
        self._distance, self._pair = math.inf, ("", "")
        self._fallback = self._uncertified = self._rejected = 0

    def add(self, tick: Tick) -> None:
        reference, report = tick.reference, tick.reference.report
        self._newest = tick
        self._ticks += 1
        self._duration += tick.dt
        self._compute_times.add(tick.compute_time)
        # Reports of obstacles are left out, because they come many times a second and would fill the list.
        self.events.extend(event for event in tick.events if event.kind is not TeleopReason.OBSTACLE_REPORTED)
        # Numbers that are not finite do not count.
        np.fmax(self._speed, np.abs(reference.v), out=self._speed)
        np.fmax(self._acceleration, np.abs(reference.a), out=self._acceleration)
        np.fmin(self._lowest, reference.q, out=self._lowest)
        np.fmax(self._highest, reference.q, out=self._highest)
        if report.closest_distance < self._distance:
            self._distance, self._pair = report.closest_distance, report.closest_pair
        self._fallback += report.fallback
        self._uncertified += not report.certified
        self._rejected += len(report.rejected)
        for arm in self._arms.values():
            arm.add(tick)
        if tick.impedance is not None and tick.wall is not None:
            self._torque = self._torque or TorqueSummary(dict.fromkeys(self.robot.arms, 0.0))
            self._torque.add(tick.dt, tick.impedance, tick.wall)

    def add_latency(self, samples: list[HandSample], now: float) -> None:
        """Count the time from the receipt of a tick's newest sample to the tick's command, sent at ``now`` [s]."""
        if samples:
            self._latency.add(now - max(max(sample.pose_stamp, sample.inputs_stamp) for sample in samples))

    def _end_error(self, arm: str) -> float | None:
        if self._newest is None or not np.isfinite(self._newest.reference.q).all():
            return None
        led = self.robot.tool_pose(self._newest.reference.q, arm)
        error = 1e3 * float(np.linalg.norm(self._newest.tools[arm].translation - led.translation))
        return error if math.isfinite(error) else None

    def summary(self, wall_time: float) -> RunSummary:
        """Return the summary of the run so far, without the figures of late ticks.

        ``wall_time`` is the duration of the run by the computer's clock [s].
        """
        robot, control = self.robot, self._control
        acceleration_limit = robot.capped_acceleration(control.acceleration_limit)
        to_limit = np.minimum(self._lowest - robot.position_lower, robot.position_upper - self._highest).min()
        moves = self._newest is not None and bool(np.abs(self._newest.reference.v).max() >= _REST)
        return RunSummary(
            ticks=self._ticks,
            duration_s=self._duration,
            loop_rate_hz=self._ticks / wall_time if wall_time > 0 else 0.0,
            real_time_factor=None,
            tick_us=self._compute_times.percentiles(1e-6),
            lateness_us=NOTHING_MEASURED,
            input_to_command_ms=self._latency.percentiles(1e-3),
            arms={
                name: replace(arm.finished(), end_error_mm=self._end_error(name)) for name, arm in self._arms.items()
            },
            min_distance_mm=1e3 * self._distance if self._distance < math.inf else None,
            closest_pair=self._pair if self._distance < math.inf else None,
            max_velocity_ratio=float((self._speed / (control.velocity_scale * robot.velocity_limit)).max()),
            max_acceleration_ratio=float((self._acceleration / acceleration_limit).max()),
            min_position_margin_rad=float(to_limit - control.position_margin) if np.isfinite(to_limit) else 0.0,
            fallback_ticks=self._fallback,
            uncertified_ticks=self._uncertified,
            rejected_targets=self._rejected,
            overruns=0,
            missed_ticks=0,
            stretched_s=0.0,
            at_rest=not moves,
            torque=self._torque,
            events=list(self.events),
        )
