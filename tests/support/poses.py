"""What tests compare poses by."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.types import Array


def pose_error(wanted: pin.SE3, pose: pin.SE3) -> Array:
    """Way from ``pose`` to ``wanted`` (6,): difference of positions [m], rotation vector [rad], in world axes."""
    return np.concatenate([wanted.translation - pose.translation, pin.log3(wanted.rotation @ pose.rotation.T)])
