"""The place of the pair of bodies that has the smallest margin."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array, StepReport


class TightestPair:
    """Finds the nearest points of the pair that a report names, in one collision model."""

    def __init__(self, model: pin.Model, pairs: pin.GeometryModel) -> None:
        self._model, self._pairs = model, pairs
        self._data, self.placed = model.createData(), pairs.createData()
        self._names = pair_names(pairs)

    def place(self, q: Array) -> None:
        """Put all bodies where the posture ``q`` (nv,) has them."""
        pin.updateGeometryPlacements(self._model, self._data, self._pairs, self.placed, q)

    def ends(self, report: StepReport) -> Array | None:
        """Return the nearest points (2, 3) of the pair, with the bodies as placed [m]; None if it is not known."""
        if report.tightest_pair not in self._names or not math.isfinite(report.margin):
            return None
        result = pin.computeDistance(self._pairs, self.placed, self._names.index(report.tightest_pair))
        return np.array([result.getNearestPoint1(), result.getNearestPoint2()])
