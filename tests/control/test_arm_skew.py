"""The two arms follow the reference with different delays, so each arm may be anywhere on its recent path."""

from __future__ import annotations

from itertools import product

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, Array, Reference
from tests.control.hunted_arms import controller_and_solver

DT = 0.002  # Duration of a control tick [s].
WINDOW = 0.03  # Largest delay of one arm behind the other arm [s].


class Ways:
    """Keeps recent postures of the reference, and computes margins with each arm at any of these postures."""

    def __init__(self, controller: CartesianController) -> None:
        self.controller, self.robot = controller, controller.robot
        self.past: list[Array] = []
        geometry, model = self.robot.collision_model, self.robot.model
        owners = []
        for body in geometry.geometryObjects:
            moving = {model.idx_vs[joint] for joint in model.supports[body.parentJoint] if joint}
            owners.append({arm for arm, its in self.robot.arms.items() if moving.intersection(its.joints)})
        pairs = [(owners[pair.first], owners[pair.second]) for pair in geometry.collisionPairs]
        self.between = np.array([bool(one and other and one != other) for one, other in pairs])

    def least_margin(self, reference: Reference) -> float:
        """Return the least margin of the pairs between the two arms [m]. Each arm is at any posture of its own path."""
        stop = self.controller.stop_deceleration
        lasts = np.abs(reference.v) / stop
        places = list(self.past[-round(WINDOW / DT) - 1 :: 7])
        for t in np.linspace(0.0, lasts.max(), 4):
            ran = np.minimum(t, lasts)
            places.append(reference.q + (reference.v - 0.5 * np.sign(reference.v) * stop * ran) * ran)
        kept, margins = self.controller.kept_distances, []
        for left, right in product(places, repeat=2):
            q = left.copy()
            q[self.robot.arms["right"].joints] = right[self.robot.arms["right"].joints]
            margins.append((self.robot.distance_values(q) - kept)[self.between].min())
        return float(min(margins))


def beside_each_other(controller: CartesianController, window: float) -> dict[str, pin.SE3]:
    """Move both tools until they are 0.15 m apart, reset the controller to rest there, and return the tool poses."""
    targets: dict[str, pin.SE3 | None] = {}
    for arm, y in zip(SIDES, (0.075, -0.075), strict=True):
        targets[arm] = pin.SE3(controller.tool_pose(arm).rotation, np.array([0.55, y, 0.45]))
    for _ in range(300):
        q = controller.step(targets, 0.01).q
    controller.allow_skew(window)
    controller.reset(q)
    return {arm: controller.tool_pose(arm) for arm in SIDES}


def swung(start: dict[str, pin.SE3], t: float, speed: float) -> dict[str, pin.SE3 | None]:
    """Return targets at the time ``t`` [s] that swing both tools sideways by 0.12 m, at up to ``speed`` [m/s]."""
    way = 0.12 * min(t, 1.0) * np.sin(speed * t / 0.12)
    return {arm: pin.SE3(pose.rotation, pose.translation + np.array([0.0, way, 0.0])) for arm, pose in start.items()}


def test_two_arms_that_swing_alike_keep_their_distance_wherever_each_arm_is_on_its_path(robot: Robot) -> None:
    controller = CartesianController(robot)
    start, ways, margins, fallbacks, errors = beside_each_other(controller, WINDOW), Ways(controller), [], 0, []
    for k in range(900):
        targets = swung(start, k * DT, 0.5)
        reference = controller.step(targets, DT)
        ways.past.append(reference.q)
        fallbacks += reference.report.fallback
        for arm, pose in targets.items():
            assert pose is not None
            errors.append(np.linalg.norm(controller.tool_pose(arm).translation - pose.translation))
        if k > 400 and k % 40 == 0:
            margins.append(ways.least_margin(reference))
    assert min(margins) >= -1e-9
    assert fallbacks <= 0.03 * 900
    assert np.sqrt(np.mean(np.square(errors[800:]))) < 0.02, "they are still followed"


@pytest.mark.slow
@pytest.mark.parametrize("window", [0.0, WINDOW])
def test_with_a_hostile_solver_arms_with_different_delays_keep_their_distance_only_if_skew_is_allowed(
    window: float,
) -> None:
    controller, solver = controller_and_solver()
    solver.fault = None
    controller.move_obstacle("hand", None)
    start, ways, margins = beside_each_other(controller, window), Ways(controller), []
    for k in range(600):
        solver.fault = ("no_rows", "towards_nearest", "no_rows", "corner")[k // 150]
        solver.q, solver.kept = controller.step({}, 1e-9).q, controller.kept_distances
        reference = controller.step(swung(start, k * DT, 0.5), DT)
        ways.past.append(reference.q)
        if k > 20 and k % 30 == 0:
            margins.append(ways.least_margin(reference))
    assert (min(margins) >= -1e-9) == (window > 0.0)


def test_an_undone_step_leaves_the_history_of_the_reference_unchanged(robot: Robot) -> None:
    controller = CartesianController(robot)
    start = beside_each_other(controller, WINDOW)
    for k in range(150):
        controller.step(swung(start, k * DT, 0.5), DT)
    history = controller._data_pointer.value.safety.history
    before = [array.copy() for array in history.kept]
    late = controller.step(swung(start, 150 * DT, 0.5), DT)
    assert not np.array_equal(before[-1], history.age)
    controller.withdraw(late)
    for array, kept in zip(history.kept, before, strict=True):
        np.testing.assert_array_equal(array, kept)


def test_if_a_longer_skew_is_allowed_the_skew_grows_with_time_and_if_a_shorter_skew_is_allowed_it_falls_at_once(
    robot: Robot,
) -> None:
    controller = CartesianController(robot)
    controller.allow_skew(0.02)
    assert controller.skew == 0.0
    controller.reset(robot.home)
    assert controller.skew == 0.02
    controller.allow_skew(0.05)
    controller.step({}, DT)
    assert controller.skew == pytest.approx(0.02 + DT)
    controller.allow_skew(0.01)
    controller.step({}, DT)
    assert controller.skew == 0.01


@pytest.mark.parametrize("time", [-0.01, 0.11, float("nan"), "0.02", None])
def test_a_skew_outside_0_to_100_ms_is_refused(robot: Robot, time: object) -> None:
    with pytest.raises(RobotError, match=r"0 to 0\.1"):
        CartesianController(robot).allow_skew(time)  # type: ignore[arg-type]
