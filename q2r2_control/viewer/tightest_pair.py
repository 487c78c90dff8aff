"""Find the nearest points of the tightest pair: the pair of bodies with the smallest margin."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array, StepReport


class TightestPair:
    """Finds the nearest points of the tightest pair that a report names. It uses the bodies of one collision model."""

    def __init__(self, model: pin.Model, pairs: pin.GeometryModel) -> None:
        self._model, self._pairs = model, pairs
        self._data, self.placed = model.createData(), pairs.createData()
        self._names = pair_names(pairs)

    def place(self, q: Array) -> None:
        """Move all bodies to their poses in the posture ``q`` (nv,) [rad]."""
        pin.updateGeometryPlacements(self._model, self._data, self._pairs, self.placed, q)

    def ends(self, report: StepReport) -> Array | None:
        """Return the nearest points (2, 3) of the pair in the world frame [m]; None if the pair is not known.

        The bodies have the poses of the last call of :meth:`place`.
        """
        if report.tightest_pair not in self._names or not math.isfinite(report.margin):
            return None
        result = pin.computeDistance(self._pairs, self.placed, self._names.index(report.tightest_pair))
        return np.array([result.getNearestPoint1(), result.getNearestPoint2()])
