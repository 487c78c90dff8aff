"""Distances as Coal measures them, beside those that a controller reports."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.geometry.pair_distance import deeper_at_corners
from q2r2_control.robot.finger_bodies import collision_model_at
from q2r2_control.robot.pairs import pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Interval, StepReport


class MeasuredDistances:
    """Of every monitored pair, and of the pairs of held objects, less what they have to be.

    ``kept`` (p,) and ``held`` (o,) [m] are what pairs and pairs of objects keep; minus infinity: it does not count.
    """

    def __init__(self, robot: Robot, kept: Array) -> None:
        self._pairs = [frozenset(pair) for pair in pair_names(robot.collision_model)]
        self._objects = {frozenset(pair) for pair in robot.objects.pair_names()}
        self._kept, self._kept_by_name = kept, dict(zip(self._pairs, kept.tolist(), strict=True))
        self._robot, self._data = robot, robot.model.createData()
        self._at_corners = deeper_at_corners(collision_model_of(robot), kept)
        self._fingers: tuple[pin.GeometryModel, pin.GeometryData] | None = None  # None: all of their way
        self._held_model = robot.objects.geometry
        self._held_data: pin.GeometryData = self._held_model.createData()
        self.forget()

    @property
    def kept(self) -> Array:
        """(p,) [m]"""
        return self._kept

    @kept.setter
    def kept(self, kept: Array) -> None:
        if kept is not self._kept:
            self._kept = kept
            self._kept_by_name = dict(zip(self._pairs, kept.tolist(), strict=True))

    def forget(self) -> None:
        """Fingers may be anywhere on their way, and no object counts."""
        self._fingers = None
        self.held = np.full(len(self._robot.objects.pair_names()), -np.inf)

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        """Between which openings each arm's gripper is; of an arm that is not named, all of the way."""
        model = collision_model_at(self._robot.collision_model, self._robot.finger_bodies, openings)
        self._fingers = model, model.createData()

    def least_of(self, postures: Array) -> float:
        """Least margin of a pair at any of ``postures`` (s, nv) [m]."""
        return min(
            min(float(self.margins(q).min(initial=np.inf)), float(self._object_margins(q).min(initial=np.inf)))
            for q in postures
        )

    def margins(self, q: Array) -> Array:
        """How much farther apart than it has to be every pair is (p,) [m]."""
        return np.asarray(self._values(q) - self.kept + self._at_corners)

    def reported_margin(self, report: StepReport) -> float:
        """Least margin that a report tells of, the nearest pair judged by what it has to keep here [m]."""
        closest = frozenset(report.closest_pair)
        if closest in self._objects:
            return report.margin
        return min(report.margin, report.closest_distance - self._kept_by_name.get(closest, 0.0))

    def compare(self, q: Array, report: StepReport) -> tuple[Array, list[float]]:
        """The margins (p,) [m], and by how much the least distance and margin of a report are wrong [m].

        Not compared are penetrations, whose depth is another quantity for Coal, pairs of objects, and boxes that may be
        touched, which are rounded for the controller.
        """
        values = self._values(q)
        margins = np.asarray(values - self.kept + self._at_corners)
        closest, tightest = frozenset(report.closest_pair), frozenset(report.tightest_pair)
        wrong: list[float] = []
        if len(values) and values.min() > 0.0 and not {closest, tightest} & self._objects:
            for found, told, pair in ((values, report.closest_distance, closest), (margins, report.margin, tightest)):
                if self.kept[int(found.argmin())] >= 0.0 <= self._kept_by_name[pair]:
                    wrong.append(abs(float(found.min()) - told))
        return margins, wrong

    def _object_margins(self, q: Array) -> Array:
        """The same of the pairs of held objects that are apart, or have to be [m]."""
        count = len(self.held)
        if not count or not np.isfinite(self.held).any():
            return np.zeros(0)
        pin.computeDistances(self._robot.model, self._data, self._held_model, self._held_data, q)
        results = list(self._held_data.distanceResults)[-count:]
        values = np.array([result.min_distance for result in results], dtype=np.float64)
        seen = np.isfinite(self.held) & ((values > 0.0) | (self.held >= 0.0))  # Coal's depth is another quantity
        return (values - self.held)[seen]

    def _values(self, q: Array) -> Array:
        """As :meth:`Robot.distance_values`, with fingers at the openings that the controller counts with."""
        if self._fingers is None:
            return self._robot.distance_values(q)
        model, data = self._fingers
        pin.computeDistances(self._robot.model, self._data, model, data, q)
        return np.array([result.min_distance for result in data.distanceResults], dtype=np.float64)
