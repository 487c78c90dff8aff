"""A cell is checked at home before its arms move. Each reason against a start is one line."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import CartesianController, ControllerSettings, Robot
from q2r2_control.supervision.preflight import preflight_faults

SETTINGS = ControllerSettings()


def test_a_home_that_a_joint_cannot_hold_against_gravity_is_a_fault(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    gravity = np.abs(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), robot.home))
    limits = robot.torque_limit.copy()
    limits[1] = gravity[1] - 0.2
    monkeypatch.setattr(robot, "torque_limit", limits)
    (fault,) = preflight_faults(robot, SETTINGS, None)
    assert fault.startswith(f"home: left_A2 needs {gravity[1]:.1f} Nm against gravity alone; allowed: its torque limit")


def test_each_pair_closer_than_min_distance_is_named_once_and_the_closest_pair_comes_first(robot: Robot) -> None:
    nearest = sorted(pair.distance for pair in robot.distances(robot.home))
    between = ControllerSettings(min_distance=float(np.mean(nearest[1:3])))
    faults = preflight_faults(robot, between, CartesianController(robot, between))
    assert len(faults) == 2
    assert f"are {1e3 * nearest[0]:.1f} mm apart" in faults[0]
    assert f"are {1e3 * nearest[1]:.1f} mm apart" in faults[1]
    assert "allowed: at least min_distance" in faults[0]


def test_a_home_without_a_certified_stop_is_a_fault(robot: Robot, controller: CartesianController) -> None:
    nearest = min(pair.distance for pair in robot.distances(robot.home))
    asking_for_more = CartesianController(robot, ControllerSettings(min_distance=nearest + 0.01))
    (fault,) = preflight_faults(robot, SETTINGS, asking_for_more)
    assert "no certified stop" in fault
    assert fault.endswith(", -10.0 mm farther apart than it has to be")
    controller.reset(robot.home + 0.05)
    assert preflight_faults(robot, SETTINGS, controller) == ()

    np.testing.assert_allclose(controller.step({}, 1e-3).q, robot.home, atol=1e-12)


@pytest.mark.parametrize(("room", "left"), [(0.3, None), (0.2005, "0.0005"), (0.1, "0")])
def test_it_is_a_fault_if_position_margin_leaves_almost_none_of_a_joints_range(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, room: float, left: str | None
) -> None:
    lower, upper = robot.position_lower.copy(), robot.position_upper.copy()
    lower[2], upper[2] = robot.home[2] - 0.5 * room, robot.home[2] + 0.5 * room
    monkeypatch.setattr(robot, "position_lower", lower)
    monkeypatch.setattr(robot, "position_upper", upper)
    faults = preflight_faults(robot, ControllerSettings(position_margin=0.1), None)
    if left is None:
        assert faults == ()
    else:
        assert faults[0].startswith(f"left_A3: position_margin leaves {left} rad of its range; to change: ")


@pytest.mark.parametrize(("by", "beyond"), [(0.01, 0), (-0.01, 0), (0.031, 1), (-0.031, 1)])
def test_a_home_nearer_to_a_joint_limit_than_the_margin_is_a_fault(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, by: float, beyond: int
) -> None:
    lower, upper = robot.position_lower.copy(), robot.position_upper.copy()
    lower[2], upper[2] = robot.home[2] - by - 0.05, robot.home[2] - by + 0.05
    monkeypatch.setattr(robot, "position_lower", lower)
    monkeypatch.setattr(robot, "position_upper", upper)
    faults = preflight_faults(robot, ControllerSettings(position_margin=0.02), None)
    assert len(faults) == beyond
    for fault in faults:
        allowed = f"{lower[2] + 0.02:g} .. {upper[2] - 0.02:g} rad, position_margin included"
        assert fault == f"home: left_A3 = {robot.home[2]:g}; allowed: {allowed}"


def test_limits_in_degrees_are_a_fault_and_a_range_of_many_turns_is_no_fault(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    lower, upper, fastest = robot.position_lower.copy(), robot.position_upper.copy(), robot.velocity_limit.copy()
    for limits in (lower, upper, fastest):
        limits[2] = np.rad2deg(limits[2])
    upper[3], fastest[4] = 100.0, 60.0  # A single large limit can be correct, so it is no fault.
    for name, limits in (("position_lower", lower), ("position_upper", upper), ("velocity_limit", fastest)):
        monkeypatch.setattr(robot, name, limits)
    (fault,) = preflight_faults(robot, SETTINGS, None)
    assert fault.startswith("left_A3: limits such as -170 .. 170 rad and")
    assert fault.endswith("are degrees; allowed in a URDF: radians and radians per second")
