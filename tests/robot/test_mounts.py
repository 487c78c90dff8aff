"""The displacement that moves one set of points onto another set is found."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

from q2r2_control.errors import RobotError
from q2r2_control.robot.mounts import fit_move

TRUE = pin.SE3(pin.exp3(np.array([0.1, -0.3, 2.0])), np.array([0.02, -0.7, 0.1]))
POINTS = np.array([[0.5, 0.1, 0.3], [0.6, -0.2, 0.3], [0.4, 0.0, 0.5], [0.55, 0.05, 0.4]])


@pytest.mark.parametrize("count", [3, 4])
def test_the_true_displacement_is_found(count: int) -> None:
    points = POINTS[:count]
    move, off = fit_move(points, np.array([TRUE.actInv(point) for point in points]))
    assert_allclose(move.homogeneous, TRUE.homogeneous, atol=1e-12)
    assert_allclose(off, 0.0, atol=1e-12)


def test_a_point_that_was_touched_at_a_wrong_position_has_the_largest_error() -> None:
    touched = np.array([TRUE.actInv(point) for point in POINTS])
    touched[2] += (0.0, 0.01, 0.0)
    _, off = fit_move(POINTS, touched)
    assert off.argmax() == 2
    assert 0.002 < off.max() < 0.01


def test_the_displacement_onto_a_mirror_image_contains_no_reflection_and_has_a_large_error() -> None:
    move, off = fit_move(POINTS, POINTS * (1.0, -1.0, 1.0))
    assert np.linalg.det(move.rotation) == pytest.approx(1.0)
    assert off.max() > 0.05


def test_points_that_determine_no_rotation_are_refused() -> None:
    line = np.array([[0.3, 0.0, 0.3], [0.5, 0.0, 0.31], [0.7, 0.0, 0.3]])
    with pytest.raises(RobotError, match="mm about a line; allowed: 30 mm or more"):
        fit_move(line, line)
    with pytest.raises(RobotError, match="2 points: allowed: 3 or more"):
        fit_move(line[:2], line[:2])
