"""In extreme states, which limits hardly allow, the QP still has a solution, and every solver keeps the contract."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from tests.control.test_scenarios import in_penetration
from tests.qp.solvers import ROBOT, controller_with, each_solver
from tests.support.driven import Driven

DT, DRIVEN = 0.002, 0.04  # Durations of a tick and of a motion [s].
TICKS = 6
Corner = tuple[Array, Array, pin.Motion]  # q and v, and the motion of the targets away from the tools [m], [rad].
OUT = pin.Motion(np.array([0.3, 0.0, 0.3]), np.zeros(3))
DOWN = pin.Motion(np.array([0.0, 0.0, -0.5]), np.array([0.0, 1.0, 0.0]))
IN = pin.Motion(np.array([-0.4, 0.0, -0.2]), np.array([0.5, 0.0, 0.5]))


def _posture(robot: Robot, *joints: float) -> Array:
    """Return a posture with every arm at the same joint positions (7,) [rad]."""
    q = robot.home.copy()
    for arm in robot.arms.values():
        q[arm.joints] = joints
    return q


def all_joints_at_upper_limits_at_full_speed(robot: Robot) -> Corner:
    return robot.position_upper.copy(), robot.velocity_limit.copy(), OUT


def all_joints_at_lower_limits_at_full_speed(robot: Robot) -> Corner:
    return robot.position_lower.copy(), -robot.velocity_limit, OUT


def stretched_straight_up(robot: Robot) -> Corner:
    return np.zeros(robot.model.nv), np.zeros(robot.model.nv), DOWN


def stretched_sideways_into_the_singularity(robot: Robot) -> Corner:
    return _posture(robot, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0), np.zeros(robot.model.nv), OUT


def wrist_and_shoulder_in_line(robot: Robot) -> Corner:
    return _posture(robot, 0.0, 0.0, 0.0, -1.5, 0.0, 0.0, 0.0), np.zeros(robot.model.nv), IN


def in_penetration_at_full_speed(robot: Robot) -> Corner:
    q, _ = in_penetration(robot)
    return q, 0.5 * robot.velocity_limit * np.where(np.arange(robot.model.nv) % 2, -1.0, 1.0), IN


def in_penetration_at_rest(robot: Robot) -> Corner:
    q, v = in_penetration(robot)
    return q, v, IN


CORNERS: dict[str, Callable[[Robot], Corner]] = {
    make.__name__.replace("_", " "): make
    for make in (
        all_joints_at_upper_limits_at_full_speed,
        all_joints_at_lower_limits_at_full_speed,
        stretched_straight_up,
        stretched_sideways_into_the_singularity,
        wrist_and_shoulder_in_line,
        in_penetration_at_full_speed,
        in_penetration_at_rest,
    )
}


def moved(controller: CartesianController, way: pin.Motion) -> dict[str, pin.SE3]:
    """Return the tool poses, displaced by the translation and rotation vector in ``way`` [m], [rad]."""
    poses = {arm: controller.tool_pose(arm) for arm in ROBOT.arms}
    turn = pin.exp3(way.angular)
    return {arm: pin.SE3(turn @ pose.rotation, pose.translation + way.linear) for arm, pose in poses.items()}


@pytest.mark.parametrize("name", CORNERS)
def test_in_an_extreme_state_the_velocity_box_is_not_empty_and_all_numbers_of_the_qp_are_finite(name: str) -> None:
    q, v, way = CORNERS[name](ROBOT)
    controller = controller_with("daqp")
    controller.reset(q, v)
    for dt in (1e-4, DT, 0.02, 0.1):
        problem = controller.problem(moved(controller, way), dt)
        assert (np.asarray(problem.lb) <= np.asarray(problem.ub)).all()
        assert np.isfinite(problem.P).all()
        assert np.isfinite(problem.q).all()
        assert problem.G is None or np.isfinite(problem.G).all()
        assert problem.h is None or np.isfinite(problem.h).all()
        assert np.linalg.eigvalsh(problem.P).min() > 0.0


@pytest.mark.parametrize("name", CORNERS)
@pytest.mark.parametrize("solver", each_solver())
def test_every_tick_from_an_extreme_state_is_solved_and_keeps_the_contract(solver: str, name: str) -> None:
    q, v, way = CORNERS[name](ROBOT)
    driven = Driven(controller_with(solver), q, v, DT)
    targets = moved(driven.controller, way)
    unsolved = [driven.drive(DT, targets).report.unsolved for _ in range(round(DRIVEN / DT))]
    assert sum(unsolved) <= 1


@pytest.mark.parametrize("sign", [1.0, -1.0], ids=["upper", "lower"])
@pytest.mark.parametrize("solver", each_solver())
def test_a_joint_at_its_limit_brakes_as_hard_as_possible_if_it_still_moves_towards_the_limit(
    solver: str, sign: float
) -> None:
    controller = controller_with(solver)
    settings = controller.settings
    braking = ROBOT.capped_acceleration(settings.acceleration_limit)
    limit = ROBOT.position_upper - settings.position_margin
    limit = limit if sign > 0.0 else ROBOT.position_lower + settings.position_margin
    unsolved, joints = 0, ROBOT.arms["left"].joints
    for joint in joints:
        q, v = ROBOT.home.copy(), np.zeros(ROBOT.model.nv)
        q[joint], v[joint] = limit[joint], sign * ROBOT.velocity_limit[joint]
        driven = Driven(controller, q, v, DT)
        problem = controller.problem(driven.start, DT)
        towards = sign * np.asarray(problem.ub if sign > 0.0 else problem.lb)[joint]
        assert towards == pytest.approx(abs(v[joint]) - braking[joint] * DT, abs=1e-9), "no room but to brake"
        for _ in range(TICKS):
            reference = driven.drive(DT, driven.start)
            unsolved += reference.report.unsolved
        assert sign * reference.v[joint] == pytest.approx(abs(v[joint]) - TICKS * braking[joint] * DT, abs=1e-6)
    # In some ticks an elbow is folded into its own arm, and 48 rows contradict each other. OSQP then finds no solution,
    # but the arm brakes just as it does with a solution.
    assert unsolved <= (0.15 if solver == "osqp" else 0.0) * TICKS * len(joints)


@pytest.mark.parametrize("solver", each_solver())
def test_arms_in_penetration_move_apart_at_the_permitted_speed(solver: str) -> None:
    q, v = in_penetration(ROBOT)
    driven = Driven(controller_with(solver), q, v, DT)
    before = driven.drive(0.05, {}).report.margin
    after = driven.drive(0.1, {}).report.margin
    assert 0.5 < (after - before) / 0.1 / driven.controller.settings.separation_recovery_speed < 1.1
