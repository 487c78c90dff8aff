"""Checks every promise of the Cartesian controller at every tick, from its references alone."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.config.control import ControllerSettings
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Reference
from q2r2_control.verification.margins import contract_margins

LONGEST_DT = 0.1  # [s]
_ROUNDING = 4.0 * np.finfo(np.float64).eps  # of a difference, relative to the numbers
_BETWEEN_SHARE, _BETWEEN_SAMPLES = 0.02, 4
_STOP_SHARE, _STOP_SAMPLES = 0.005, 41


def time_of(dt: Any) -> float:
    """Seconds that a tick of ``dt`` moves the reference by: 0 for what is no time, 0.1 s at most."""
    if not (isinstance(dt, int | float | np.floating) and math.isfinite(dt) and dt > 0.0):
        return 0.0
    return min(float(dt), LONGEST_DT)


class ContractWatch:
    """Keeps the worst margin of every promise; distances between ticks and during stops are sampled, by Coal.

    A start outside the limits, too fast or in penetration is allowed: for what it breaks the promise is to recover, and
    the margins say so. Ticks longer than one substep move along several parabolas that a reference does not show; they
    are checked at the ticks.
    """

    def __init__(self, robot: Robot, settings: ControllerSettings, random: np.random.Generator) -> None:
        self.margins = contract_margins()
        self.broken: list[str] = []  # keys of the margins that the last tick broke
        self._robot, self._random = robot, random
        self._a = settings.acceleration_limit
        self._v_max = robot.velocity_limit * settings.velocity_scale
        self._lower = robot.position_lower + settings.position_margin
        self._upper = robot.position_upper - settings.position_margin
        self._min_distance = settings.min_distance
        self._substep = settings.max_substep
        self._tick = 0

    def start(self, q: Array, v: Array) -> None:
        """The controller was reset to ``q`` [rad], ``v`` [rad/s], (nv,) each."""
        self._q, self._v = q.copy(), v.copy()
        self._outside = np.maximum(np.maximum(self._lower - q, q - self._upper), 0.0)
        self._excess = np.maximum(np.abs(v) - self._v_max, 0.0)
        self._can_stop = self._stops_inside(q, v)
        self._slow = self._excess == 0.0
        distances = self._robot.distance_values(q)
        self._from_rest = not v.any()
        self._apart = (distances >= self._min_distance) & self._from_rest
        # Whether a certificate has to be known from now on. A start at rest with all apart is its own.
        self._certain = self._from_rest and bool(self._apart.all())
        self._least = float(distances.min(initial=np.inf)) if self._certain else -np.inf

    def check(self, tick: int, reference: Reference, dt: Any, unusable: frozenset[str], failed: bool) -> list[str]:
        """One tick; ``failed``: every solution of it was unusable. Returns the keys of the promises that it broke."""
        self._tick, self.broken = tick, []
        q, v, h, report = reference.q, reference.v, time_of(dt), reference.report
        finite = bool(np.isfinite(np.sum(q) + np.sum(v) + np.sum(reference.a)))
        self._note("not_finite", float(not finite))
        if not finite:
            return self.broken
        self._note("unreported", len(unusable.difference(report.rejected)))
        self._note("refused", len(set(report.rejected) - unusable))
        if h == 0.0:
            self._note("idle", float(np.max(np.abs(q - self._q) + np.abs(v - self._v))))
        else:
            self._check_motion(q, v, reference.a, h)
            if failed:
                self._check_stopped(q, v, h, report.fallback)
        self._check_limits(q, v)
        self._check_distance(report.closest_distance, report.certified)
        self._sample(q, v, h, report.closest_distance)
        self._q, self._v = q, v
        return self.broken

    def _note(self, key: str, value: float) -> None:
        if not self.margins[key].note(value, self._tick):
            self.broken.append(key)

    def _check_motion(self, q: Array, v: Array, a: Array, h: float) -> None:
        speed = np.abs(v)
        change = np.abs(v - self._v) - _ROUNDING * speed
        self._note("acceleration", max(float(change.max()) / (self._a * h), float(np.abs(a).max()) / self._a))
        way = np.abs(q - self._q) - _ROUNDING * np.abs(q)
        self._note("jump", float(np.max(way / ((np.maximum(speed, np.abs(self._v)) + self._a * h) * h))))
        if h <= self._substep:
            self._parabola = bool(np.abs(self._q + 0.5 * h * (self._v + v) - q).max() <= 1e-11)
            self._note("parabola", 0.0 if self._parabola else self._off_the_stop(q, v, h))

    def _check_stopped(self, q: Array, v: Array, h: float, fallback: bool) -> None:
        self._note("not_stopped", self._off_the_stop(q, v, h))
        self._note("unsaid", float(not fallback))

    def _off_the_stop(self, q: Array, v: Array, h: float) -> float:
        """How far a tick of ``h`` [s] was from full braking, or, in recovery, from stopping all joints together."""
        stops = [self._braked(self._q, self._v, h)]
        if not self._certain:
            stops.append(self._braked(self._q, self._v, h, together=True))
        return min(max(float(np.abs(stop_q - q).max()), float(np.abs(stop_v - v).max())) for stop_q, stop_v in stops)

    def _braked(self, q: Array, v: Array, t: float | Array, together: bool = False) -> tuple[Array, Array]:
        """Position and velocity after full braking for ``t`` [s], a number or (s, 1); or all joints ``together``."""
        duration = np.abs(v) / self._a
        if together:
            duration = np.full_like(v, duration.max())
        time = np.minimum(t, duration)
        brake = np.divide(v, duration, out=np.zeros_like(v), where=duration > 0.0)
        return q + v * time - 0.5 * brake * time * time, v - brake * time

    def _check_limits(self, q: Array, v: Array) -> None:
        excess = np.abs(v) - self._v_max
        if self._slow.all():
            self._note("velocity", float(np.max(np.abs(v) / self._v_max)))
        else:
            above = np.maximum(excess, 0.0)
            self._note("too_fast", float(np.max(above - self._excess)))
            self._excess = above
            self._slow |= above == 0.0
        room = np.minimum(q - self._lower, self._upper - q)
        if self._can_stop.all():
            self._note("position", float(room.min()))
            return
        if self._can_stop.any():
            self._note("position", float(room[self._can_stop].min()))
        outside = np.maximum(-room, 0.0)
        coasting = np.abs(v) >= np.abs(self._v)
        self._note("outward", float(np.max(np.where(coasting, outside - self._outside, 0.0))))
        self._outside = outside
        self._can_stop |= self._stops_inside(q, v)

    def _stops_inside(self, q: Array, v: Array) -> npt.NDArray[np.bool_]:
        """Joints inside their limits that full braking, begun one substep late, keeps there."""
        end = q + v * np.abs(v) / (2.0 * self._a) + v * self._substep
        inside = (np.minimum(q, end) >= self._lower) & (np.maximum(q, end) <= self._upper)
        return np.asarray(inside, dtype=np.bool_)

    def _check_distance(self, least: float, certified: bool) -> None:
        if self._certain:
            self._note("distance", least - self._min_distance)
            self._note("uncertified", float(not certified))
        elif self._from_rest and self._least > -np.inf:
            self._note("approach", min(self._least, self._min_distance) - least)
        self._certain |= certified
        self._least = least

    def _sample(self, q: Array, v: Array, h: float, least: float) -> None:
        """Every now and then look closer, at distances that the controller did not measure itself."""
        draw = self._random.random()
        if draw < _BETWEEN_SHARE:
            values = self._robot.distance_values(q)
            if values.min(initial=np.inf) > 0.0:  # Coal's penetration depth is another quantity
                self._note("truth", abs(float(values.min()) - least) if len(values) else 0.0)
            if not self._certain and self._apart.any():
                self._note("bystanders", float(values[self._apart].min()) - self._min_distance)
            if self._certain and 0.0 < h <= self._substep:
                self._note("between", self._least_between(v, h) - self._min_distance)
        if draw < _STOP_SHARE and self._certain:
            duration = float(np.abs(v).max()) / self._a
            times = duration * (np.arange(_STOP_SAMPLES) + self._random.random()) / _STOP_SAMPLES
            self._note("stop", self._least_of(self._braked(q, v, times[:, None])[0]) - self._min_distance)
        if draw < _STOP_SHARE and self._can_stop.all():
            end = q + v * np.abs(v) / (2.0 * self._a)
            self._note("stop_position", float(np.minimum(end - self._lower, self._upper - end).min()))

    def _least_between(self, v: Array, h: float) -> float:
        times = h * self._random.random((_BETWEEN_SAMPLES, 1))
        if self._parabola:
            return self._least_of(self._q + times * self._v + 0.5 * times**2 / h * (v - self._v))
        return self._least_of(self._braked(self._q, self._v, times)[0])

    def _least_of(self, postures: Array) -> float:
        return min(float(self._robot.distance_values(q).min(initial=np.inf)) for q in postures)
