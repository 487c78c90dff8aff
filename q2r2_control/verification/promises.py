"""The promises of the Cartesian controller, the worst value of each, and distances that Coal measures."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np

from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.geometry.pair_distance import deeper_at_corners
from q2r2_control.control.safety.safety_data import ROUNDING
from q2r2_control.robot.coal_distances import CoalDistances
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Interval, StepReport

RELATIVE = 1e-9  # Relative tolerance of the limits in the contract.
COAL = 2e-6  # Largest error of Coal's distance between a capsule and a box [m].

PROMISES = {  # For each key: name, unit, comparison and bound of the value.
    "exceptions": ("exceptions raised by step", "", "<=", 0.0),
    "not_finite": ("references that are not finite", "", "<=", 0.0),
    "unreported": ("unusable targets not reported", "", "<=", 0.0),
    "refused": ("usable targets rejected", "", "<=", 0.0),
    "idle": ("motion in a dt that is no time", "rad", "<=", 0.0),
    "acceleration": ("acceleration / limit", "", "<=", 1.0 + RELATIVE),
    "velocity": ("velocity / limit", "", "<=", 1.0 + RELATIVE),
    "too_fast": ("started too fast: faster still", "rad/s", "<=", 0.0),
    "position": ("room to position limits", "rad", ">=", -1e-11),
    "outward": ("started outside limits: further out", "rad", "<=", 0.0),
    "deceleration": ("deceleration of the stop / limit", "", "<=", 1.0 + RELATIVE),
    "jump": ("travel in a tick / what v allows", "", "<=", 1.0),
    "parabola": ("off constant acceleration or the stop", "rad", "<=", 1e-11),
    "distance": ("distance - kept distance, at ticks", "m", ">=", -ROUNDING),
    "between": ("distance - kept distance, between ticks", "m", ">=", -COAL),
    "stop": ("distance - kept distance, full stops", "m", ">=", -COAL),
    "stop_position": ("room to position limits, full stops", "rad", ">=", -RELATIVE),
    "jerk": ("jerk of averaged commands / limit", "", "<=", 1.0 + 1e-6),
    "command_acceleration": ("acceleration of averaged commands / limit", "", "<=", 1.0 + 1e-6),
    "command_distance": ("distance - kept distance, averaged commands", "m", ">=", -COAL),
    "tool_speed": ("tool speed / limit, at ticks, between and in stops", "", "<=", 1.0 + RELATIVE),
    "coal": ("reported distance off Coal's", "m", "<=", COAL),
    "bystanders": ("pairs apart while others recover", "m", ">=", -COAL),
    "uncertified": ("certificates lost", "", "<=", 0.0),
    "withdrawn": ("kept distance: less than before, and than asked for, by", "m", "<=", 0.0),
    "loosened": ("held objects: kept distance falls by", "m", "<=", 0.0),
    "approach": ("recovery: closer by, in a tick", "m", "<=", 1e-9),
    "not_stopped": ("solver failed: off the stop", "rad", "<=", 1e-11),
    "unsaid": ("solver failed: stop not reported", "", "<=", 0.0),
}


@dataclass(slots=True)
class Margin:
    """One promise. ``worst`` has to stay at or below ``allowed`` (``sense`` "<="), or at or above it (">=")."""

    name: str
    unit: str
    sense: str
    allowed: float
    worst: float = field(init=False)
    tick: int | None = None  # Tick of the worst value.
    checked: int = 0  # Number of values that were checked.
    violations: int = 0  # Number of values that broke the promise.

    def __post_init__(self) -> None:
        self.worst = -math.inf if self.sense == "<=" else math.inf

    def note(self, value: float, tick: int) -> bool:
        """Keep the worst value, and return False if the promise is broken. NaN breaks it."""
        self.checked += 1
        sign = 1.0 if self.sense == "<=" else -1.0
        kept = sign * value <= sign * self.allowed
        self._keep_worst(value, tick)
        self.violations += not kept
        return kept

    def add(self, other: Margin) -> None:
        """Add the results of another run for the same promise. ``tick`` becomes the tick of the worst value of both."""
        self.checked += other.checked
        self.violations += other.violations
        self._keep_worst(other.worst, other.tick)

    def _keep_worst(self, value: float, tick: int | None) -> None:
        sign = 1.0 if self.sense == "<=" else -1.0
        if not (sign * value <= sign * self.worst or math.isnan(self.worst)):
            self.worst, self.tick = value, tick

    def described(self, value: float) -> str:
        """Return a text with one value of this promise and the allowed bound."""
        return f"{self.name}: {f'{value:.12g} {self.unit}'.rstrip()}, allowed {self.sense} {self.allowed:.12g}"


class MeasuredDistances:
    """Margins of all monitored pairs and of the pairs of held objects: distances minus the kept distances.

    ``kept`` (p,) has the kept distances of monitored pairs, and ``held`` (o,) has the kept distances of pairs of held
    objects [m]. A pair whose kept distance is minus infinity does not count.
    """

    def __init__(self, robot: Robot, kept: Array) -> None:
        self._pairs = {frozenset(pair): index for index, pair in enumerate(pair_names(robot.collision_model))}
        self._objects = {frozenset(pair) for pair in robot.objects.pair_names()}
        self.kept = kept
        self._robot = robot
        self._at_corners = deeper_at_corners(collision_model_of(robot), kept)
        self._fingers: CoalDistances | None = None  # None if fingers may be anywhere between open and closed.
        objects = robot.objects.geometry.copy()
        for pair in robot.collision_model.collisionPairs:  # Only the pairs of held objects stay.
            objects.removeCollisionPair(pair)
        self._of_objects = CoalDistances(robot.model, objects)
        self.forget()

    def forget(self) -> None:
        """Forget openings and grasps. Fingers may then be anywhere between open and closed, and no object counts."""
        self._fingers = None
        self.held = np.full(len(self._robot.objects.pair_names()), -np.inf)

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        """Set the interval of each gripper's opening. Without an interval, a gripper can have any opening."""
        model = collision_model_at(self._robot.collision_model, self._robot.finger_bodies, openings)
        self._fingers = CoalDistances(self._robot.model, model)

    def least_of(self, postures: Array) -> float:
        """Return the least margin of a pair at any of ``postures`` (s, nv) [m]."""
        return min(
            min(float(self.margins(q).min(initial=np.inf)), float(self._object_margins(q).min(initial=np.inf)))
            for q in postures
        )

    def margins(self, q: Array) -> Array:
        """Return the margin of every pair (p,): its distance minus its kept distance [m]."""
        return np.asarray(self._values(q) - self.kept + self._at_corners)

    def reported_margin(self, report: StepReport) -> float:
        """Return the smaller of two margins in a report [m]: of its tightest pair, and of its nearest pair."""
        closest = frozenset(report.closest_pair)
        if closest in self._objects:
            return report.margin
        kept = float(self.kept[self._pairs[closest]]) if closest in self._pairs else 0.0
        return min(report.margin, report.closest_distance - kept)

    def compare(self, q: Array, report: StepReport) -> tuple[Array, list[float]]:
        """Return the margins (p,) [m], and the errors of the least distance and margin in a report [m].

        There are no errors while a pair is in penetration, because Coal defines the depth differently. Pairs that may
        touch are not compared, because the controller rounds their boxes. Pairs of held objects and of moving obstacles
        are not compared, because they are not among the monitored pairs.
        """
        values, margins = self._values(q), self.margins(q)
        closest, tightest = frozenset(report.closest_pair), frozenset(report.tightest_pair)
        wrong: list[float] = []
        if len(values) and values.min() > 0.0 and {closest, tightest} <= self._pairs.keys():
            for found, told, pair in ((values, report.closest_distance, closest), (margins, report.margin, tightest)):
                if self.kept[int(found.argmin())] >= 0.0 <= self.kept[self._pairs[pair]]:
                    wrong.append(abs(float(found.min()) - told))
        return margins, wrong

    def _object_margins(self, q: Array) -> Array:
        """Return the margins [m] of the pairs of held objects that are apart, or that have to be apart."""
        if not np.isfinite(self.held).any():
            return np.zeros(0)
        values = self._of_objects.at(q)
        # Coal defines the depth of a penetration differently, so pairs that may touch count only while they are apart.
        seen = np.isfinite(self.held) & ((values > 0.0) | (self.held >= 0.0))
        return (values - self.held)[seen]

    def _values(self, q: Array) -> Array:
        """Return :meth:`Robot.distance_values`, with fingers at the openings that the controller assumes."""
        return self._robot.distance_values(q) if self._fingers is None else self._fingers.at(q)
