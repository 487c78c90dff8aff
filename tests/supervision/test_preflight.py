"""What keeps a cell from running, found before anything moves."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.supervision.homing import preflight_faults

SETTINGS = ControllerSettings()


def test_a_home_outside_a_limit_is_named_with_what_is_allowed(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    home = robot.home.copy()
    home[1] = 2.09
    monkeypatch.setattr(robot, "home", home)
    (fault,) = [line for line in preflight_faults(robot, SETTINGS, None) if "left_A2" in line]
    assert fault == "home: left_A2 = 2.09; allowed: -2.0844 .. 2.0844 rad, position_margin included"


def test_every_pair_closer_than_min_distance_is_named_once_and_nearest_first(robot: Robot) -> None:
    nearest = sorted(pair.distance for pair in robot.distances(robot.home))
    between = ControllerSettings(min_distance=float(np.mean(nearest[1:3])))
    faults = preflight_faults(robot, between, CartesianController(robot, between))
    assert len(faults) == 2
    assert f"are {1e3 * nearest[0]:.1f} mm apart" in faults[0]
    assert f"are {1e3 * nearest[1]:.1f} mm apart" in faults[1]
    assert "allowed: at least min_distance" in faults[0]


def test_a_home_where_the_controller_knows_no_certified_stop_is_a_fault(robot: Robot) -> None:
    nearest = min(pair.distance for pair in robot.distances(robot.home))
    asking_for_more = CartesianController(robot, ControllerSettings(min_distance=nearest + 0.01))
    (fault,) = preflight_faults(robot, SETTINGS, asking_for_more)
    assert "no certified stop" in fault
    assert preflight_faults(robot, SETTINGS, None) == ()


def test_looking_leaves_the_controller_at_rest_at_home(robot: Robot, controller: CartesianController) -> None:
    controller.reset(robot.home + 0.05)
    preflight_faults(robot, SETTINGS, controller)
    reference = controller.step({}, 1e-3)
    np.testing.assert_allclose(reference.q, robot.home, atol=1e-12)
