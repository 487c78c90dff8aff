"""Measure the distances of all pairs of a geometry model by Coal, for checks that do not use our kernels."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array


class CoalDistances:
    """Measures every collision pair of a geometry model, in the order of its pairs."""

    def __init__(self, model: pin.Model, geometry: pin.GeometryModel) -> None:
        self.model, self.geometry = model, geometry
        self.data: pin.Data = model.createData()
        self.geometry_data: pin.GeometryData = geometry.createData()
        # This list is made once, because looking up each result again would take longer than measuring. Pinocchio
        # writes later results into the same objects.
        self._results = list(self.geometry_data.distanceResults)

    def at(self, q: Array) -> Array:
        """Return the distances (pairs,) [m] at ``q`` (nv,); negative if the shapes of a pair overlap."""
        pin.computeDistances(self.model, self.data, self.geometry, self.geometry_data, q)
        return self.measured()

    def measured(self) -> Array:
        """Return the distances (pairs,) [m] that Coal measured last with ``geometry_data``."""
        return np.array([result.min_distance for result in self._results], dtype=np.float64)
