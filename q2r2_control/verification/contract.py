"""The contract of the Cartesian controller, checked at every tick from its references alone.

One checker for tests, soaks and live runs: :meth:`Contract.check` raises at the first promise that is broken,
:meth:`Contract.observe` only keeps the worst margin of each.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.geometry.rounded_boxes import deeper_at_corners
from q2r2_control.robot.finger_openings import collision_model_at
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import LONGEST_DT, Array, Interval, Reference, StepReport

_NEWEST = 5000  # ticks whose accelerations are kept
_ROUNDING = 4.0 * np.finfo(np.float64).eps  # of a difference, relative to the numbers
_RELATIVE = 1e-9  # to which the contract promises limits
_COAL = 2e-6  # how exactly Coal measures a capsule from a box [m]
_BETWEEN_SHARE, _BETWEEN_SAMPLES = 0.02, 4  # share of the ticks that are sampled, and postures in each
_STOP_SHARE, _STOP_SAMPLES = 0.005, 41

_PROMISES = {  # key: name, unit, and what its value has to be
    "exceptions": ("exceptions raised by step", "", "<=", 0.0),
    "not_finite": ("references that are not finite", "", "<=", 0.0),
    "unreported": ("unusable targets not reported", "", "<=", 0.0),
    "refused": ("usable targets rejected", "", "<=", 0.0),
    "idle": ("motion in a dt that is no time", "rad", "<=", 0.0),
    "acceleration": ("acceleration / limit", "", "<=", 1.0 + _RELATIVE),
    "velocity": ("velocity / limit", "", "<=", 1.0 + _RELATIVE),
    "too_fast": ("started too fast: faster still", "rad/s", "<=", 0.0),
    "position": ("room to position limits", "rad", ">=", -1e-11),
    "outward": ("started outside limits: further out", "rad", "<=", 0.0),
    "deceleration": ("deceleration of the stop / limit", "", "<=", 1.0 + _RELATIVE),
    "jump": ("travel in a tick / what v allows", "", "<=", 1.0),
    "parabola": ("off constant acceleration or the stop", "rad", "<=", 1e-11),
    "distance": ("distance - kept distance, at ticks", "m", ">=", 0.0),
    "between": ("distance - kept distance, between ticks", "m", ">=", -_COAL),
    "stop": ("distance - kept distance, full stops", "m", ">=", -_COAL),
    "stop_position": ("room to position limits, full stops", "rad", ">=", -_RELATIVE),
    "coal": ("reported distance off Coal's", "m", "<=", _COAL),
    "bystanders": ("pairs apart while others recover", "m", ">=", -_COAL),
    "uncertified": ("certificates lost", "", "<=", 0.0),
    "loosened": ("held objects: kept distance falls by", "m", "<=", 0.0),
    "approach": ("recovery: closer by, in a tick", "m", "<=", 1e-9),
    "not_stopped": ("solver failed: off the stop", "rad", "<=", 1e-11),
    "unsaid": ("solver failed: stop not reported", "", "<=", 0.0),
}


@dataclass(slots=True)
class Margin:
    """One promise: ``worst`` has to stay at or below ``allowed`` (``sense`` "<=") or at or above it (">=")."""

    name: str
    unit: str
    sense: str
    allowed: float
    worst: float = field(init=False)
    tick: int | None = None  # of the worst
    checked: int = 0
    violations: int = 0

    def __post_init__(self) -> None:
        self.worst = -math.inf if self.sense == "<=" else math.inf

    def note(self, value: float, tick: int) -> bool:
        """Keep the worst; False where the promise is broken. What is not a number breaks it."""
        self.checked += 1
        if self.sense == "<=":
            worse, kept = not value <= self.worst, value <= self.allowed
        else:
            worse, kept = not value >= self.worst, value >= self.allowed
        if worse and not math.isnan(self.worst):
            self.worst, self.tick = value, tick
        self.violations += not kept
        return kept

    def described(self, value: float) -> str:
        """One value of this promise beside what is allowed."""
        return f"{self.name}: {f'{value:.12g} {self.unit}'.rstrip()}, allowed {self.sense} {self.allowed:.12g}"


class Checked(Protocol):
    """What a contract has to know of its controller."""

    robot: Robot
    settings: ControllerSettings

    @property
    def stop_deceleration(self) -> Array: ...

    @property
    def object_distances(self) -> Array: ...


def time_of(dt: Any) -> float:
    """Seconds that a tick of ``dt`` moves the reference by: 0 for what is no time, 0.1 s at most."""
    if not (isinstance(dt, int | float | np.floating) and math.isfinite(dt) and dt > 0.0):
        return 0.0
    return min(float(dt), LONGEST_DT)


class Contract:
    """Checks one reference after another, from a start at ``q`` [rad], ``v`` [rad/s], (nv,) each; by default at home.

    A start outside the limits, too fast or in penetration is allowed: for what it breaks the promise is to recover, and
    the margins say so. Distances between ticks and during full stops are measured by Coal, in ticks drawn by
    ``random``, or in all of them with ``sample_all``. Ticks longer than one substep move along several parabolas that a
    reference does not show; they are checked at the ticks.
    """

    def __init__(
        self,
        controller: Checked,
        q: Array | None = None,
        v: Array | None = None,
        *,
        random: np.random.Generator | None = None,
        sample_all: bool = False,
    ) -> None:
        self.margins = {key: Margin(*row) for key, row in _PROMISES.items()}
        self.ticks = self.fallbacks = self.uncertified = 0
        self._broken: dict[str, float] = {}
        robot, settings = controller.robot, controller.settings
        self._controller = controller
        self._robot, self._random = robot, np.random.default_rng(0) if random is None else random
        self._data = robot.model.createData()
        self._sample_all = sample_all
        self._a = robot.capped_acceleration(settings.acceleration_limit)
        self._v_max = robot.velocity_limit * settings.velocity_scale
        self._lower = robot.position_lower + settings.position_margin
        self._upper = robot.position_upper - settings.position_margin
        self._kept = kept_distances(robot, settings).values
        self._at_corners = deeper_at_corners(collision_model_of(robot), self._kept)
        pairs = map(frozenset, pair_names(robot.collision_model))
        self._kept_by_name = dict(zip(pairs, self._kept.tolist(), strict=True))
        self._objects = [frozenset(pair) for pair in robot.objects.pair_names()]
        self._held_model = robot.objects.geometry
        self._held_data: pin.GeometryData = self._held_model.createData()
        self._substep = settings.max_substep
        self.start(robot.home if q is None else q, v)

    def start(self, q: Array, v: Array | None = None) -> None:
        """The controller was reset to ``q`` [rad], ``v`` [rad/s], (nv,) each; without ``v`` at rest."""
        v = np.zeros_like(q) if v is None else v
        self._q, self._v, self._stop = q.copy(), v.copy(), self._controller.stop_deceleration
        self._fingers: tuple[pin.GeometryModel, pin.GeometryData] | None = None  # None: all of their way
        self._outside = np.maximum(np.maximum(self._lower - q, q - self._upper), 0.0)
        self._excess = self._excess_of(v)
        self._can_stop = self._stops_inside(q, v)
        self._slow = self._excess == 0.0
        self._held = np.full(len(self._objects), -np.inf)  # what pairs of objects keep [m]
        margins = self._margins(q)
        self._from_rest = not v.any()
        self._apart = (margins >= 0.0) & self._from_rest
        # Whether a certificate has to be known from now on. A start at rest with all apart is its own.
        self._certain = self._from_rest and bool(self._apart.all())
        self._least = float(margins.min(initial=np.inf)) if self._certain else -np.inf
        self._newest: deque[tuple[float, float]] = deque(maxlen=_NEWEST)  # duration [s], duration times |a|^2

    def set_openings(self, openings: Mapping[str, Interval], *, before_step: bool = True) -> None:
        """The controller has accepted ``openings``: its fingers are others, and ``before_step`` its stop may be.

        Who is told of references only, and so is late, leaves the stop as the last reference had it.
        """
        if before_step:
            self._stop = self._controller.stop_deceleration
        model = collision_model_at(self._robot.collision_model, self._robot.finger_bodies, openings)
        self._fingers = model, model.createData()

    def _note_objects(self) -> None:
        """Take over what pairs of objects keep, which never falls while they count."""
        held = self._controller.object_distances
        counted = np.isfinite(self._held) & np.isfinite(held)
        if counted.any():
            self._note("loosened", float((self._held[counted] - held[counted]).max()))
        self._held = held

    def check(
        self, reference: Reference, dt: Any, unusable: frozenset[str] | None = None, failed: bool = False
    ) -> None:
        """Like :meth:`observe`. Raises :class:`AssertionError` with the broken promises and the values seen."""
        broken = self.observe(reference, dt, unusable, failed)
        if broken:
            found = "; ".join(self.margins[key].described(value) for key, value in broken.items())
            raise AssertionError(f"tick {self.ticks - 1}: {found}")

    def observe(
        self, reference: Reference, dt: Any, unusable: frozenset[str] | None = None, failed: bool = False
    ) -> dict[str, float]:
        """Check one tick of ``dt`` [s]. Returns the keys of the promises that it broke, with the values seen.

        ``unusable``: arms whose target has to be reported as rejected, and no others; None: not checked.
        ``failed``: every solution of this tick was unusable, so that the stop has to be executed.
        """
        self._broken = {}
        q, v, h, report = reference.q, reference.v, time_of(dt), reference.report
        finite = bool(np.isfinite(np.sum(q) + np.sum(v) + np.sum(reference.a)))
        self._note("exceptions", 0.0)
        self._note("not_finite", float(not finite))
        if finite:
            if unusable is not None:
                self._note("unreported", len(unusable.difference(report.rejected)))
                self._note("refused", len(set(report.rejected) - unusable))
            if h == 0.0:
                self._note("idle", float(np.max(np.abs(q - self._q) + np.abs(v - self._v))))
            else:
                self._check_motion(q, v, reference.a, h)
                if failed:
                    self._check_stopped(q, v, h, report.fallback)
            self._check_limits(q, v)
            self._check_distance(self._margin_of(report), report.certified)
            stop = self._controller.stop_deceleration
            self._note("deceleration", float((stop / self._a).max()))
            self._note_objects()
            self._sample(q, v, stop, h, report)
            self._count(reference, h)
            self._q, self._v, self._stop = q, v, stop
        self.ticks += 1
        return self._broken

    def raised(self) -> None:
        """Count a tick in which ``step`` raised an exception instead of returning a reference."""
        self._note("exceptions", 1.0)
        self.ticks += 1

    def tail_acceleration(self, duration: float = 0.5) -> float:
        """Norm over the joints of the RMS acceleration over the last ``duration`` [s], in rad/s^2."""
        total, time = 0.0, 0.0
        for h, square in reversed(self._newest):
            total, time = total + square, time + h
            if time >= duration:
                break
        return math.sqrt(total / time)

    @property
    def fallback_share(self) -> float:
        """Share of ticks that did not execute the solver's solution."""
        return self.fallbacks / max(self.ticks, 1)

    def _count(self, reference: Reference, h: float) -> None:
        self.fallbacks += reference.report.fallback
        self.uncertified += not reference.report.certified
        self._newest.append((h, h * float(reference.a @ reference.a)))

    def _note(self, key: str, value: float) -> None:
        if not self.margins[key].note(value, self.ticks):
            self._broken[key] = value

    def _check_motion(self, q: Array, v: Array, a: Array, h: float) -> None:
        speed = np.abs(v)
        change = np.abs(v - self._v) - _ROUNDING * speed
        self._note("acceleration", float((np.maximum(change / h, np.abs(a)) / self._a).max()))
        travel = np.abs(q - self._q) - _ROUNDING * np.abs(q)
        self._note("jump", float(np.max(travel / ((np.maximum(speed, np.abs(self._v)) + self._a * h) * h))))
        if h <= self._substep:
            self._parabola = bool(np.abs(self._q + 0.5 * h * (self._v + v) - q).max() <= 1e-11)
            self._note("parabola", 0.0 if self._parabola else self._off_the_stop(q, v, h))

    def _check_stopped(self, q: Array, v: Array, h: float, fallback: bool) -> None:
        self._note("not_stopped", self._off_the_stop(q, v, h))
        self._note("unsaid", float(not fallback))

    def _off_the_stop(self, q: Array, v: Array, h: float) -> float:
        """How far a tick of ``h`` [s] was from the stop that was known before it."""
        stop_q, stop_v = self._braked(self._q, self._v, self._stop, h)
        return max(float(np.abs(stop_q - q).max()), float(np.abs(stop_v - v).max()))

    def _braked(self, q: Array, v: Array, deceleration: Array, t: float | Array) -> tuple[Array, Array]:
        """Position and velocity ``t`` [s] into a stop with a ``deceleration`` (nv,); ``t`` is a number or (s, 1)."""
        time = np.minimum(t, np.abs(v) / deceleration)
        brake = np.sign(v) * deceleration
        return q + v * time - 0.5 * brake * time * time, v - brake * time

    def _check_limits(self, q: Array, v: Array) -> None:
        excess = self._excess_of(v)
        if self._slow.any():
            self._note("velocity", float(np.max((np.abs(v) / self._v_max)[self._slow])))
        if not self._slow.all():
            self._note("too_fast", float(np.max((excess - self._excess)[~self._slow])))
        self._excess = excess
        self._slow |= excess == 0.0
        room = np.minimum(q - self._lower, self._upper - q)
        if self._can_stop.any():
            self._note("position", float(room[self._can_stop].min()))
        if self._can_stop.all():
            return
        outside = np.maximum(-room, 0.0)
        coasting = np.abs(v) >= np.abs(self._v)
        self._note("outward", float(np.max(np.where(coasting & ~self._can_stop, outside - self._outside, 0.0))))
        self._outside = outside
        self._can_stop |= self._stops_inside(q, v)

    def _excess_of(self, v: Array) -> Array:
        """Speed above the limit (nv,) [rad/s]."""
        return np.asarray(np.maximum(np.abs(v) - self._v_max * (1.0 + _RELATIVE), 0.0))

    def _stops_inside(self, q: Array, v: Array) -> npt.NDArray[np.bool_]:
        """Joints inside their limits that full braking, begun one substep late, keeps there."""
        end = q + v * np.abs(v) / (2.0 * self._a) + v * self._substep
        inside = (np.minimum(q, end) >= self._lower) & (np.maximum(q, end) <= self._upper)
        return np.asarray(inside, dtype=np.bool_)

    def _margin_of(self, report: StepReport) -> float:
        """Least margin that a report tells of, the nearest pair judged by what it has to keep here [m]."""
        closest = frozenset(report.closest_pair)
        if closest in self._objects:
            return report.margin
        nearest = report.closest_distance - self._kept_by_name.get(closest, 0.0)
        return min(report.margin, nearest)

    def _check_distance(self, least: float, certified: bool) -> None:
        """``least`` is the least margin of a pair [m]."""
        if self._certain or (self._from_rest and self._least >= 0.0):
            self._note("distance", least)
        elif self._from_rest and self._least > -np.inf:
            self._note("approach", self._least - least)
        if self._certain:
            self._note("uncertified", float(not certified))
        self._certain |= certified
        self._least = least

    def _sample(self, q: Array, v: Array, stop: Array, h: float, report: StepReport) -> None:
        """Measure distances that the controller did not measure itself."""
        draw = 0.0 if self._sample_all else self._random.random()
        if draw < _BETWEEN_SHARE:
            values = self._distances(q)
            margins = values - self._kept + self._at_corners
            of_object = {frozenset(report.closest_pair), frozenset(report.tightest_pair)} & set(self._objects)
            if len(values) and values.min() > 0.0 and not of_object:  # Coal's penetration depth is another quantity
                # Boxes that may be touched are rounded for the controller.
                if self._kept[int(values.argmin())] >= 0.0 <= self._kept_by_name[frozenset(report.closest_pair)]:
                    self._note("coal", abs(float(values.min()) - report.closest_distance))
                if self._kept[int(margins.argmin())] >= 0.0 <= self._kept_by_name[frozenset(report.tightest_pair)]:
                    self._note("coal", abs(float(margins.min()) - report.margin))
            if not self._certain and self._apart.any():
                self._note("bystanders", float(margins[self._apart].min()))
            if self._certain and 0.0 < h <= self._substep:
                self._note("between", self._least_between(v, h))
        if draw < _STOP_SHARE and self._certain:
            duration = float(np.max(np.abs(v) / stop))
            times = duration * (np.arange(_STOP_SAMPLES) + self._random.random()) / _STOP_SAMPLES
            self._note("stop", self._least_of(self._braked(q, v, stop, times[:, None])[0]))
        if draw < _STOP_SHARE and self._can_stop.all():
            end = q + v * np.abs(v) / (2.0 * stop)
            self._note("stop_position", float(np.minimum(end - self._lower, self._upper - end).min()))

    def _least_between(self, v: Array, h: float) -> float:
        times = h * self._random.random((_BETWEEN_SAMPLES, 1))
        if self._parabola:
            return self._least_of(self._q + times * self._v + 0.5 * times**2 / h * (v - self._v))
        return self._least_of(self._braked(self._q, self._v, self._stop, times)[0])

    def _least_of(self, postures: Array) -> float:
        """Least margin of a pair at any of ``postures`` (s, nv) [m]."""
        return min(
            min(float(self._margins(q).min(initial=np.inf)), float(self._object_margins(q).min(initial=np.inf)))
            for q in postures
        )

    def _margins(self, q: Array) -> Array:
        """How much farther apart than it has to be every pair is (p,) [m]."""
        return self._distances(q) - self._kept + self._at_corners

    def _object_margins(self, q: Array) -> Array:
        """The same of the pairs of held objects that are apart, or have to be [m]."""
        count = len(self._held)
        if not count or not np.isfinite(self._held).any():
            return np.zeros(0)
        pin.computeDistances(self._robot.model, self._data, self._held_model, self._held_data, q)
        results = list(self._held_data.distanceResults)[-count:]
        values = np.array([result.min_distance for result in results], dtype=np.float64)
        seen = np.isfinite(self._held) & ((values > 0.0) | (self._held >= 0.0))  # Coal's depth is another quantity
        return (values - self._held)[seen]

    def _distances(self, q: Array) -> Array:
        """As :meth:`Robot.distance_values`, with fingers at the openings that the controller counts with."""
        if self._fingers is None:
            return self._robot.distance_values(q)
        model, data = self._fingers
        pin.computeDistances(self._robot.model, self._data, model, data, q)
        return np.array([result.min_distance for result in data.distanceResults], dtype=np.float64)
