"""The contract of the Cartesian controller, checked at every tick from its references alone.

:meth:`Contract.check` raises at the first broken promise. :meth:`Contract.observe` keeps the worst margins.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Mapping
from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.robot.kept_distances import kept_by_objects, kept_distances
from q2r2_control.types import LONGEST_DT, Array, Interval, Reference, StepReport, is_number
from q2r2_control.verification.averaged_commands import AveragedCommands
from q2r2_control.verification.promises import PROMISES, RELATIVE, Margin, MeasuredDistances
from q2r2_control.verification.tool_speeds import MeasuredToolSpeeds

_NEWEST = 5000  # Number of ticks whose accelerations are kept.
_ROUNDING = 4.0 * np.finfo(np.float64).eps  # Rounding error of a difference, relative to the numbers.
# Postures between two ticks: probability that they are measured at a tick, and the number of measured postures.
_BETWEEN_SHARE, _BETWEEN_SAMPLES = 0.02, 4
# Postures during a full stop: probability that they are measured at a tick, and the number of measured postures.
_STOP_SHARE, _STOP_SAMPLES = 0.005, 41
# If the margin is below the first number [m], both probabilities are larger by this factor.
_NEAR, _NEAR_SHARE = 1e-3, 10.0


def time_of(dt: Any) -> float:
    """Return the time by which a tick of ``dt`` moves the reference [s]: 0 for an invalid time, and at most 0.1 s."""
    return min(float(dt), LONGEST_DT) if is_number(dt) and dt > 0.0 else 0.0


class Contract:
    """Checks one reference after another.

    The start is at ``q`` (nv,) [rad] with ``v`` (nv,) [rad/s]; by default at rest at home. A start outside the limits,
    too fast or in penetration is allowed. For the limits that the start breaks, the promise is to recover, and separate
    margins check that. Coal measures distances between ticks and during full stops, in ticks that ``random`` chooses,
    or in all ticks if ``sample_all`` is True. In a tick longer than one substep, the joints move along several
    parabolas. The reference does not contain these parabolas, so only the tick's end is checked.
    """

    def __init__(
        self,
        controller: CartesianController,
        q: Array | None = None,
        v: Array | None = None,
        *,
        random: np.random.Generator | None = None,
        sample_all: bool = False,
    ) -> None:
        self.margins = {key: Margin(*row) for key, row in PROMISES.items()}
        self.ticks = self.fallbacks = self.uncertified = 0
        self._broken: dict[str, float] = {}
        robot, settings = controller.robot, controller.settings
        self._controller = controller
        self._robot, self._sample_all = robot, sample_all
        self._random = np.random.default_rng(0) if random is None else random
        self._a = robot.capped_acceleration(settings.acceleration_limit)
        self._v_max = robot.velocity_limit * settings.velocity_scale
        self._lower = robot.position_lower + settings.position_margin
        self._upper = robot.position_upper - settings.position_margin
        self._ask(settings)
        self._measured = MeasuredDistances(robot, controller.kept_distances)
        self._tool_limit, self._tools = settings.tool_speed_limit, MeasuredToolSpeeds(robot)
        self._commands = None if settings.jerk_limit is None else AveragedCommands(robot, settings, self._measured)
        self._substep = settings.max_substep
        self.start(robot.home if q is None else q, v)

    def start(self, q: Array, v: Array | None = None) -> None:
        """Begin again, after the controller was reset to ``q`` [rad], ``v`` [rad/s], (nv,) each; by default at rest."""
        v = np.zeros_like(q) if v is None else v
        self._measured.kept = self._controller.kept_distances
        self._q, self._v, self._stop = q.copy(), v.copy(), self._controller.stop_deceleration
        self._measured.forget()
        if self._commands is not None:
            self._commands.start(q)
        self._outside = np.maximum(np.maximum(self._lower - q, q - self._upper), 0.0)
        self._excess = self._excess_of(v)
        self._can_stop = self._stops_inside(q, v)
        self._slow = self._excess == 0.0
        margins = self._measured.margins(q)
        self._from_rest = not v.any()
        self._apart = (margins >= -ROUNDING) & self._from_rest
        # Whether every tick must have a certificate now. A start at rest with all pairs apart is certified by itself.
        self._certain = self._from_rest and bool(self._apart.all())
        self._least = float(margins.min(initial=np.inf)) if self._certain else -np.inf
        # For each of the newest ticks: its duration [s], and its duration times |a|^2 [rad^2/s^3].
        self._newest: deque[tuple[float, float]] = deque(maxlen=_NEWEST)

    def set_openings(self, openings: Mapping[str, Interval], *, before_step: bool = True) -> None:
        """Take the ``openings`` that the controller has accepted.

        ``before_step`` is False if the caller learns only after a step that the controller has accepted them.
        """
        if before_step:
            self._stop = self._controller.stop_deceleration
        self._measured.set_openings(openings)
        if self._commands is not None:
            self._commands.bodies_changed()

    def _ask(self, settings: ControllerSettings) -> None:
        self._settings = settings
        self._asked = kept_distances(self._robot, settings).values
        self._asked_of_objects = kept_by_objects(self._robot, settings).values

    def _note_kept(self) -> None:
        """Check that no kept distance falls below the smaller of its last value and the distance in the settings."""
        before, kept, settings = self._measured.kept, self._controller.kept_distances, self._controller.settings
        if settings is not self._settings:
            self._ask(settings)
        if len(before):
            self._note("withdrawn", float((np.minimum(before, self._asked) - kept).max()))
        self._measured.kept = kept  # At this tick, pairs have to keep these distances.

    def _note_objects(self) -> None:
        """Take the kept distances of held objects from the controller.

        While a pair counts, check that its kept distance does not fall below the distance in the settings.
        """
        held = self._controller.object_distances
        counted = np.isfinite(self._measured.held) & np.isfinite(held)
        if counted.any():
            before = np.minimum(self._measured.held, self._asked_of_objects)[counted]
            self._note("loosened", float((before - held[counted]).max()))
        self._measured.held = held

    def check(
        self, reference: Reference, dt: Any, unusable: frozenset[str] | None = None, failed: bool = False
    ) -> None:
        """Check one tick as :meth:`observe` does. Raises :class:`AssertionError` with the broken promises."""
        if broken := self.observe(reference, dt, unusable, failed):
            found = "; ".join(self.margins[key].described(value) for key, value in broken.items())
            raise AssertionError(f"tick {self.ticks - 1}: {found}")

    def observe(
        self, reference: Reference, dt: Any, unusable: frozenset[str] | None = None, failed: bool = False
    ) -> dict[str, float]:
        """Check one tick of ``dt`` [s]; returns the keys of the promises that it broke, with their values.

        Args:
            reference: The reference after the tick.
            dt: Duration of the tick [s]; any invalid value is allowed.
            unusable: Exactly the arms whose targets have to be reported as rejected; None for no check.
            failed: Whether every solution of this tick was unusable, so that the stop has to be executed.
        """
        self._broken = {}
        q, v, h, report = reference.q, reference.v, time_of(dt), reference.report
        finite = bool(np.isfinite(np.sum(q) + np.sum(v) + np.sum(reference.a)))
        self._note_kept()
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
                    self._note("not_stopped", self._off_the_stop(q, v, h))
                    self._note("unsaid", float(not report.fallback))
            self._check_limits(q, v)
            self._check_distance(self._measured.reported_margin(report), report.certified)
            self._check_tools(q, v)
            stop = self._controller.stop_deceleration
            self._note("deceleration", float((stop / self._a).max()))
            self._note_objects()
            if self._commands is not None:
                for key, value in self._commands.update(q, v, h).items():
                    self._note(key, value)
            self._sample(q, v, stop, h, report)
            self.fallbacks += report.fallback
            self.uncertified += not report.certified
            self._newest.append((h, h * float(reference.a @ reference.a)))
            self._q, self._v, self._stop = q, v, stop
        self.ticks += 1
        return self._broken

    def raised(self) -> None:
        """Count a tick in which ``step`` raised an exception instead of returning a reference."""
        self._note("exceptions", 1.0)
        self.ticks += 1

    def tail_acceleration(self, duration: float = 0.5) -> float:
        """Return the RMS, over the last ``duration`` [s], of the norm of all joints' accelerations [rad/s^2]."""
        total, time = 0.0, 0.0
        for h, square in reversed(self._newest):
            total, time = total + square, time + h
            if time >= duration:
                break
        return math.sqrt(total / time)

    @property
    def fallback_share(self) -> float:
        """The share of ticks that did not execute the solver's solution."""
        return self.fallbacks / max(self.ticks, 1)

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

    def _off_the_stop(self, q: Array, v: Array, h: float) -> float:
        """Return the deviation of a tick of ``h`` [s] from the certified stop that was known before the tick."""
        stop_q, stop_v = self._braked(self._q, self._v, self._stop, h)
        return max(float(np.abs(stop_q - q).max()), float(np.abs(stop_v - v).max()))

    def _braked(self, q: Array, v: Array, deceleration: Array, t: float | Array) -> tuple[Array, Array]:
        """Return position and velocity (nv,) at ``t`` [s] in a stop from ``q`` and ``v`` with ``deceleration`` (nv,).

        If ``t`` is (s, 1), both results are (s, nv).
        """
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
        """Return the speed above the limit (nv,) [rad/s]."""
        return np.asarray(np.maximum(np.abs(v) - self._v_max * (1.0 + RELATIVE), 0.0))

    def _stops_inside(self, q: Array, v: Array) -> npt.NDArray[np.bool_]:
        """Return which joints are inside their limits, and stay there if full braking begins one substep later."""
        end = q + v * np.abs(v) / (2.0 * self._a) + v * self._substep
        inside = (np.minimum(q, end) >= self._lower) & (np.maximum(q, end) <= self._upper)
        return np.asarray(inside, dtype=np.bool_)

    def _check_distance(self, least: float, certified: bool) -> None:
        """Check distance and certificate of a tick; ``least`` is the least margin of a pair [m]."""
        if self._certain or (self._from_rest and self._least >= 0.0):
            self._note("distance", least)
        elif self._from_rest and self._least > -np.inf:
            self._note("approach", self._least - least)
        if self._certain:
            self._note("uncertified", float(not certified))
        self._certain |= certified
        self._least = least

    def _check_tools(self, q: Array, v: Array) -> None:
        """Check the speeds of the tools at ``q`` [rad] and ``v`` [rad/s].

        Both have the shape (nv,), or the shape (n, nv) with a row for each of n instants.
        """
        if self._tool_limit is not None and self._certain:
            self._note("tool_speed", self._tools.fastest(q, v) / self._tool_limit)

    def _sample(self, q: Array, v: Array, stop: Array, h: float, report: StepReport) -> None:
        """In randomly chosen ticks, measure distances with Coal: at the tick, between ticks and during a full stop."""
        draw = 0.0 if self._sample_all else self._random.random()
        if report.margin < _NEAR:
            draw /= _NEAR_SHARE
        if draw < _BETWEEN_SHARE:
            margins, wrong = self._measured.compare(q, report)
            for error in wrong:
                self._note("coal", error)
            if not self._certain and self._apart.any():
                self._note("bystanders", float(margins[self._apart].min()))
            if self._commands is not None and self._certain and (least := self._commands.least_margin()) is not None:
                self._note("command_distance", least)
            if self._certain and 0.0 < h <= self._substep:
                times = h * self._random.random((_BETWEEN_SAMPLES, 1))
                between, speeds = self._braked(self._q, self._v, self._stop, times)
                if self._parabola:
                    between = self._q + times * self._v + 0.5 * times**2 / h * (v - self._v)
                    speeds = self._v + times / h * (v - self._v)
                self._note("between", self._measured.least_of(between))
                self._check_tools(between, speeds)
        if draw < _STOP_SHARE and self._certain:
            duration = float(np.max(np.abs(v) / stop))
            times = duration * (np.arange(_STOP_SAMPLES) + self._random.random()) / _STOP_SAMPLES
            braked, speeds = self._braked(q, v, stop, times[:, None])
            self._note("stop", self._measured.least_of(braked))
            self._check_tools(braked, speeds)
        if draw < _STOP_SHARE and self._can_stop.all():
            end = q + v * np.abs(v) / (2.0 * stop)
            self._note("stop_position", float(np.minimum(end - self._lower, self._upper - end).min()))
