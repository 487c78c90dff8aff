"""Find the pose of one arm's base from points that the tips of both arms have touched."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.errors import RobotError
from q2r2_control.types import Array

_LEAST_SPREAD = 0.03  # Least RMS distance of the points from the line that fits them best [m].


def fit_move(points: Array, touched: Array) -> tuple[pin.SE3, Array]:
    """Return the rigid motion that brings ``touched`` (n, 3) onto ``points`` (n, 3) [m], and the errors (n,) [m].

    It is the least-squares solution without a scale: Umeyama, Least-Squares Estimation of Transformation Parameters
    Between Two Point Patterns, 1991.

    Raises:
        RobotError: If there are fewer than three points, or if they lie on a line.
    """
    if len(points) < 3:
        raise RobotError(f"{len(points)} points: allowed: 3 or more")
    middle, other_middle = points.mean(axis=0), touched.mean(axis=0)
    spread = float(np.linalg.svd(points - middle, compute_uv=False)[1]) / np.sqrt(len(points))
    if spread < _LEAST_SPREAD:
        raise RobotError(
            f"the points are {1e3 * spread:.0f} mm about a line; allowed: {1e3 * _LEAST_SPREAD:g} mm or more, so that "
            "they tell how the arm is turned"
        )
    U, _, Vt = np.linalg.svd((points - middle).T @ (touched - other_middle))
    rotation = U @ np.diag([1.0, 1.0, np.linalg.det(U @ Vt)]) @ Vt
    move = pin.SE3(rotation, middle - rotation @ other_middle)
    return move, np.linalg.norm(points - (touched @ rotation.T + move.translation), axis=1)
