"""How far apart pairs stay whatever is decided next, as far as that is known without a sample."""

from __future__ import annotations

import numpy as np

from q2r2_control.control.safety.safety_data import SafetyData
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.types import Array


def provable_distances(model: SafetyModel, data: SafetyData) -> Array:
    """d - S of every pair (p,) [m]: the stop that is at hand brings it no closer than that (stop_certificate.py).

    Needs the distances at the reference as it is. A pair may be asked to keep as much from now on: then the stop at
    hand is proven with that, as if it had always been so.
    """
    pairs, state = model.collision.pairs, data.state
    travel = 0.5 * state.v**2 / data.certified
    way = (pairs.reach * travel[pairs.joint - 1]).sum(axis=1)  # reach is 0 where there is no joint
    return np.asarray(data.distance - way)
