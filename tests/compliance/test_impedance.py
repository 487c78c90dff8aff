"""The impedance controller without a simulator: its formulas, its bounds, and what bad numbers do to it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
import scipy.linalg
from pydantic import ValidationError

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.compliance.impedance_terms import (
    PositionLimits,
    bound_torque,
    clip_error,
    consistent_projector,
    double_diagonalised_damping,
    kinematic_projector,
    limit_repulsion,
    task_inertia,
)
from q2r2_control.config import load_config
from q2r2_control.config.control import ImpedanceSettings
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState
from tests.support.poses import pose_error
from tests.support.torque_loop import reference

DT = 0.001
SETTINGS = ImpedanceSettings(torque_rate_limit=1000.0)  # 1 Nm a tick
STRETCHED = np.zeros(14)


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


def at(q: Array, v: Array | None = None) -> RobotState:
    return RobotState(q, np.zeros_like(q) if v is None else v, np.zeros_like(q), None, 0.0)


def gravity(robot: Robot, q: Array) -> Array:
    return np.array(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))


def left_arm(robot: Robot, q: Array) -> tuple[Array, Array]:
    """Jacobian (6, 7) and inertia (7, 7) of the left arm."""
    data, arm = robot.model.createData(), robot.arms["left"]
    pin.computeJointJacobians(robot.model, data, q)
    J = pin.getFrameJacobian(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)[:, arm.joints]
    return J, pin.crba(robot.model, data, q)[np.ix_(arm.joints, arm.joints)]


def inverse(M: Array) -> Array:
    return np.asarray(np.linalg.inv(M), dtype=np.float64)


def positive_definite(random: np.random.Generator, n: int) -> Array:
    A = random.normal(size=(n, n))
    matrix: Array = A @ A.T + 0.1 * np.eye(n)
    return matrix


class TestClipping:
    @pytest.mark.parametrize(
        ("error", "expected"),
        [
            ([0.03, 0.0, 0.04, 0.0, 0.3, 0.4], [0.03, 0.0, 0.04, 0.0, 0.3, 0.4]),
            ([0.3, 0.0, 0.4, 0.0, 0.3, 0.0], [0.06, 0.0, 0.08, 0.0, 0.3, 0.0]),
            ([0.0, 0.0, 0.01, 3.0, 0.0, 0.0], [0.0, 0.0, 0.01, 0.5, 0.0, 0.0]),
        ],
        ids=["short", "far", "turned"],
    )
    def test_each_part_is_clipped_by_its_length_and_keeps_its_direction(
        self, error: list[float], expected: list[float]
    ) -> None:
        clipped, was = clip_error(np.array(error), 0.1, 0.5)
        np.testing.assert_allclose(clipped, expected, atol=1e-15)
        assert was == (error != expected)


class TestDamping:
    @pytest.mark.parametrize("ratio", [0.1, 0.7, 1.0, 2.0])
    @pytest.mark.parametrize("n", [1, 6, 7])
    def test_it_is_the_formula_of_the_paper(self, ratio: float, n: int) -> None:
        random = np.random.default_rng(n)
        for _ in range(20):
            stiffness, inertia = random.uniform(10, 5000, n), positive_definite(random, n)
            values, V = scipy.linalg.eigh(np.diag(stiffness), inertia)
            np.testing.assert_allclose(V.T @ inertia @ V, np.eye(n), atol=1e-8)
            Q = np.linalg.inv(V)
            expected = 2 * Q.T @ np.diag(ratio * np.sqrt(values)) @ Q
            damping = double_diagonalised_damping(stiffness, inertia, ratio)
            np.testing.assert_allclose(damping, expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())

    @pytest.mark.parametrize("ratio", [0.1, 0.7, 0.95])
    def test_every_mode_has_the_ratio_where_the_simple_formula_misses_it(self, robot: Robot, ratio: float) -> None:
        J, M = left_arm(robot, robot.home)
        stiffness, inertia = np.array([2000.0] * 3 + [200.0] * 3), task_inertia(J, inverse(M))

        def ratios(damping: Array) -> Array:
            flow = -np.linalg.solve(inertia, np.hstack([np.diag(stiffness), damping]))
            poles = np.linalg.eigvals(np.vstack([np.hstack([np.zeros((6, 6)), np.eye(6)]), flow]))
            return -poles.real / np.abs(poles)

        np.testing.assert_allclose(ratios(double_diagonalised_damping(stiffness, inertia, ratio)), ratio, rtol=1e-6)
        assert np.abs(ratios(2 * ratio * np.diag(np.sqrt(stiffness))) - ratio).max() > 0.5 * ratio


class TestTaskInertia:
    def test_where_the_arm_moves_freely_it_is_exact(self, robot: Robot) -> None:
        J, M = left_arm(robot, robot.home)
        inertia = task_inertia(J, inverse(M))
        np.testing.assert_allclose(inertia @ J @ np.linalg.solve(M, J.T), np.eye(6), atol=1e-9)

    def test_in_a_singular_posture_no_direction_is_heavier_than_1000_kg(self, robot: Robot) -> None:
        J, M = left_arm(robot, STRETCHED)
        assert np.linalg.matrix_rank(J) < 6
        inertia = task_inertia(J, inverse(M))
        metres = np.array([1.0, 1.0, 1.0, 0.3, 0.3, 0.3])
        heaviest = np.linalg.eigvalsh(inertia / np.outer(metres, metres)).max()
        assert heaviest == pytest.approx(1000.0)

    def test_rotors_are_part_of_it(self, robot: Robot) -> None:
        _, M = left_arm(robot, robot.home)
        assert (np.diag(M) >= robot.model.armature[:7]).all()
        assert (robot.model.armature > 1.0).all()


class TestNullspace:
    def test_dynamically_consistent_torque_accelerates_no_tool(self, robot: Robot) -> None:
        J, M = left_arm(robot, robot.home)
        M_inverse = inverse(M)
        N = consistent_projector(J, M_inverse, task_inertia(J, M_inverse))
        np.testing.assert_allclose(J @ M_inverse @ N, 0, atol=1e-9)
        assert np.trace(N) == pytest.approx(1.0)

    def test_kinematic_torque_is_balanced_without_a_force_at_the_tool(self, robot: Robot) -> None:
        J, _ = left_arm(robot, robot.home)
        N = kinematic_projector(J)
        np.testing.assert_allclose(J @ N, 0, atol=1e-9)
        np.testing.assert_allclose(N, np.eye(7) - J.T @ np.linalg.pinv(J.T), atol=1e-9)
        assert np.trace(N) == pytest.approx(1.0)

    def test_a_push_at_the_tool_loads_no_posture(self, robot: Robot) -> None:
        J, M = left_arm(robot, robot.home)
        M_inverse = inverse(M)
        for N in (consistent_projector(J, M_inverse, task_inertia(J, M_inverse)), kinematic_projector(J)):
            np.testing.assert_allclose(N @ J.T, 0, atol=1e-9)

    def test_around_a_singular_posture_neither_jumps_nor_amplifies_without_bound(self, robot: Robot) -> None:
        projectors = []
        for bend in np.linspace(-0.02, 0.02, 41):
            q = STRETCHED.copy()
            q[3] = bend
            J, M = left_arm(robot, q)
            M_inverse = inverse(M)
            projectors.append((consistent_projector(J, M_inverse, task_inertia(J, M_inverse)), kinematic_projector(J)))
        steps = np.diff(np.array(projectors), axis=0)
        assert np.abs(projectors).max() < 10.0
        assert np.abs(steps).max() < 0.1


class TestLimitRepulsion:
    LIMITS = PositionLimits(np.full(3, -1.0), np.full(3, 1.0), stiffness=300.0, damping=20.0, distance=0.1)

    def torque(self, q: float, v: float = 0.0, wanted: float = 0.0) -> float:
        torques = limit_repulsion(self.LIMITS, np.full(3, q), np.full(3, v), np.full(3, wanted))
        assert np.ptp(torques) == 0
        return float(torques[0])

    def test_it_is_a_spring_that_begins_before_the_limit(self) -> None:
        assert [self.torque(q) for q in (-0.9, 0.0, 0.9)] == [0.0, 0.0, 0.0]
        assert self.torque(0.95) == pytest.approx(-15.0)
        assert self.torque(-0.95) == pytest.approx(15.0)
        assert self.torque(1.1) == pytest.approx(-60.0)

    def test_it_brakes_what_approaches_and_never_holds_what_leaves(self) -> None:
        assert self.torque(0.95, v=1.0) == pytest.approx(-25.0)
        assert self.torque(0.95, v=-1.0) == pytest.approx(-5.0)
        assert self.torque(0.95, v=-3.0) == 0.0
        assert self.torque(-0.95, v=3.0) == 0.0

    def test_it_leaves_a_joint_alone_that_is_where_the_reference_wants_it(self) -> None:
        assert self.torque(0.97, wanted=0.97) == 0.0
        assert self.torque(0.98, wanted=0.97) == pytest.approx(-3.0)
        assert self.torque(-0.98, wanted=-0.97) == pytest.approx(3.0)

    def test_it_never_jumps(self) -> None:
        torques = [self.torque(q, v=0.5) for q in np.linspace(0.8, 1.1, 3001)]
        assert np.abs(np.diff(torques)).max() < 0.05


def test_both_torque_bounds_hold_whatever_is_asked_for() -> None:
    random = np.random.default_rng(5)
    limit = np.array([176.0, 110.0, 40.0])
    last = np.zeros(3)
    saturated = np.zeros(3, dtype=bool)
    for _ in range(5000):
        wanted = random.choice([-1e300, -1e3, -50.0, 0.0, 50.0, 1e3, 1e300], 3) * random.random(3)
        change = random.choice([0.0, 1.0, 5.0, 1e9])
        bounded = bound_torque(wanted, last, limit, change)
        assert (np.abs(bounded.tau) <= limit).all()
        assert (np.abs(bounded.tau - last) <= change * (1 + 1e-12)).all()
        free = ~(bounded.saturated | bounded.rate_limited)
        np.testing.assert_array_equal(bounded.tau[free], wanted[free])
        saturated |= bounded.saturated & ~bounded.rate_limited
        last = bounded.tau
    assert saturated.all()


class TestSettings:
    @pytest.mark.parametrize(
        "key",
        [
            "translational_stiffness",
            "rotational_stiffness",
            "damping_ratio",
            "nullspace_stiffness",
            "nullspace_damping_ratio",
            "limit_stiffness",
            "limit_damping",
            "torque_scale",
            "torque_rate_limit",
            "ramp_time",
        ],
    )
    @pytest.mark.parametrize("value", [0.0, -1.0, np.inf, np.nan, 1e9])
    def test_what_would_not_hold_the_arm_is_refused(self, key: str, value: float) -> None:
        with pytest.raises(ValidationError, match=key):
            ImpedanceSettings.model_validate({key: value})


class TestController:
    @pytest.mark.parametrize("scale", [1.0, 0.5])
    def test_the_first_torque_is_gravitys_at_the_measured_posture(self, robot: Robot, scale: float) -> None:
        controller = ImpedanceController(robot, ImpedanceSettings(torque_scale=scale))
        q = robot.home + 0.1
        controller.reset(at(q))
        # Wherever the newest reference is: it is due only at the end of the tick.
        command = controller.step(reference(q + 0.2), at(q), DT)
        np.testing.assert_allclose(command.tau, gravity(robot, q), atol=1e-9)
        assert not command.report.held
        assert command.report.clipped == ()

    def test_it_pulls_the_tool_towards_the_reference_with_the_stiffness_asked_for(self, robot: Robot) -> None:
        settings = ImpedanceSettings(torque_rate_limit=1e5)
        controller = ImpedanceController(robot, settings)
        controller.reset(at(robot.home))
        q = robot.home.copy()
        q[:7] += 0.01
        tau = controller.step(reference(robot.home), at(q), DT).tau - gravity(robot, q)
        J, M = left_arm(robot, q)
        force = np.linalg.solve(J @ np.linalg.solve(M, J.T), J @ np.linalg.solve(M, tau[:7]))
        error = pose_error(robot.tool_pose(robot.home, "left"), robot.tool_pose(q, "left"))
        np.testing.assert_allclose(force, np.repeat([2000.0, 200.0], 3) * error, rtol=1e-6, atol=1e-9)
        np.testing.assert_allclose(tau[7:], 0, atol=1e-9)

    def test_a_reference_that_accelerates_gets_the_torque_that_takes(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, ImpedanceSettings(torque_rate_limit=1e5))
        a = np.linspace(-2, 2, 14)
        controller.reset(at(robot.home))
        tau = controller.step(reference(robot.home, a=a), at(robot.home), DT).tau
        data = robot.model.createData()
        np.testing.assert_allclose(tau, pin.rnea(robot.model, data, robot.home, np.zeros(14), a), atol=1e-9)

    def test_extra_torque_is_added_and_bounded_with_the_rest(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        extra = np.zeros(14)
        extra[0], extra[5] = 0.5, 1e6
        command = controller.step(reference(robot.home), at(robot.home), DT, extra)
        added = command.tau - gravity(robot, robot.home)
        np.testing.assert_allclose(added[[0, 5]], [0.5, 1.0], atol=1e-9)
        assert command.report.saturated == command.report.rate_limited == ("left_A6",)

    def test_a_far_reference_pulls_no_more_than_the_clip_lets_it(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        q = robot.home.copy()
        q[:7] += 0.6
        command = controller.step(reference(robot.home), at(q), DT)
        assert command.report.clipped == ("left",)
        assert np.linalg.norm(command.report.errors["left"][:3]) == pytest.approx(0.1)
        assert np.linalg.norm(command.report.errors["left"][3:]) <= 0.5 + 1e-12
        assert np.linalg.norm(command.report.errors["right"]) == pytest.approx(0.0, abs=1e-12)

    def test_a_joint_pushed_to_its_limit_is_named(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        q = robot.home.copy()
        q[9] = robot.position_upper[9] - 0.02
        assert controller.step(reference(robot.home), at(q), DT).report.repelled == ("right_A3",)

    @pytest.mark.parametrize("field", ["q", "v"])
    @pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
    def test_a_state_that_is_no_state_holds_the_last_gravity_torque_and_says_so(
        self, robot: Robot, field: str, value: float
    ) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        good = at(robot.home)
        controller.reset(good)
        q = robot.home + 0.05
        for _ in range(200):
            last = controller.step(reference(robot.home), at(q), DT).tau
        broken = getattr(good, field).copy()
        broken[3] = value
        for _ in range(200):
            command = controller.step(reference(robot.home), replace(good, **{field: broken}), DT)
            assert command.report.held
            assert (np.abs(command.tau - last) <= 1.0 + 1e-9).all()
            last = command.tau
        np.testing.assert_allclose(last, gravity(robot, q), atol=1e-9)
        assert not controller.step(reference(robot.home), good, DT).report.held

    @pytest.mark.parametrize("magnitude", [1e10, 1e160, 1e300])
    def test_absurd_numbers_lead_to_bounded_torque(self, robot: Robot, magnitude: float) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        last = gravity(robot, robot.home)
        for sign in (1.0, -1.0):
            for absurd in (at(robot.home, sign * magnitude + STRETCHED), at(sign * magnitude + STRETCHED)):
                with np.errstate(all="ignore"):
                    tau = controller.step(reference(robot.home), absurd, DT).tau
                assert np.isfinite(tau).all()
                assert (np.abs(tau - last) <= 1.0 + 1e-9).all()
                last = tau

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_a_reference_that_is_no_reference_is_held(self, robot: Robot, value: float) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        moved = at(robot.home + 0.01)
        for _ in range(50):
            expected = controller.step(reference(robot.home), moved, DT).tau
        for broken in (
            reference(robot.home + value),
            reference(robot.home, v=STRETCHED + value),
            reference(robot.home, a=STRETCHED + value),
        ):
            command = controller.step(broken, moved, DT)
            np.testing.assert_allclose(command.tau, expected, atol=1e-9)
            assert not command.report.held

    def test_extra_torque_that_is_no_number_holds_gravity(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        command = controller.step(reference(robot.home), at(robot.home), DT, np.full(14, np.nan))
        assert command.report.held
        np.testing.assert_allclose(command.tau, gravity(robot, robot.home), atol=1e-9)

    @pytest.mark.parametrize(("dt", "change"), [(0.0, 0.0), (-1.0, 0.0), (np.nan, 0.0), (0.01, 10.0), (50.0, 100.0)])
    def test_the_torque_changes_with_the_time_that_passed(self, robot: Robot, dt: float, change: float) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        controller.reset(at(robot.home))
        tau = controller.step(reference(robot.home), at(robot.home), dt, np.full(14, 1e4)).tau
        expected = np.minimum(gravity(robot, robot.home) + change, robot.torque_limit)
        np.testing.assert_allclose(tau, expected, atol=1e-9)

    @pytest.mark.parametrize("bad", [np.full(14, np.nan), np.zeros(7)], ids=["NaN", "one arm"])
    def test_a_start_at_no_posture_is_refused(self, robot: Robot, bad: Array) -> None:
        with pytest.raises(RobotError, match="expected 14 finite numbers"):
            ImpedanceController(robot).reset(at(bad))


class TestAnImpedanceThatChanges:
    def test_it_changes_on_a_straight_line_over_the_ramp_time(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, ImpedanceSettings(ramp_time=0.1))
        controller.reset(at(robot.home))
        before = controller.in_force("right")
        asked = {
            **{"translational_stiffness": 500.0, "rotational_stiffness": 150.0, "damping_ratio": 0.5},
            **{"nullspace_stiffness": 10.0, "nullspace_damping_ratio": 0.7},
        }
        controller.change(asked, arm="left")
        for tick in range(1, 121):
            controller.step(reference(robot.home), at(robot.home), DT)
            share = min(tick / 100, 1.0)
            now = {name: value + share * (asked[name] - value) for name, value in before.items()}
            assert controller.in_force("left") == pytest.approx(now)
            assert controller.in_force("right") == before
        assert controller.in_force("left") == asked

    def test_another_change_begins_where_the_last_one_is_and_what_it_does_not_name_goes_on(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, ImpedanceSettings(ramp_time=0.1))
        controller.reset(at(robot.home))

        def tick(count: int) -> None:
            for _ in range(count):
                controller.step(reference(robot.home), at(robot.home), DT)

        controller.change({"damping_ratio": 0.5, "nullspace_stiffness": 10.0})
        tick(50)
        controller.change({"damping_ratio": 1.75}, arm="left")
        tick(50)
        # What was not changed again was on its way for the ramp's time.
        posture = [controller.in_force(arm)["nullspace_stiffness"] for arm in ("left", "right")]
        assert posture == pytest.approx([10.0, 10.0])
        assert [controller.in_force(arm)["damping_ratio"] for arm in ("left", "right")] == pytest.approx([1.25, 0.5])
        tick(50)
        assert [controller.in_force(arm)["damping_ratio"] for arm in ("left", "right")] == [1.75, 0.5]

    def test_what_is_in_force_afterwards_is_as_if_the_controller_had_been_made_with_it(self, robot: Robot) -> None:
        soft = {"translational_stiffness": 300.0, "damping_ratio": 0.4, "nullspace_stiffness": 20.0}
        made = ImpedanceController(robot, ImpedanceSettings(**soft))
        changed = ImpedanceController(robot)
        changed.change(soft)
        random = np.random.default_rng(2)
        for controller in (made, changed):
            controller.reset(at(robot.home))
        for _ in range(50):
            q, v = robot.home + random.normal(0.0, 0.02, 14), random.normal(0.0, 0.1, 14)
            expected, found = (one.step(reference(robot.home), at(q, v), DT).tau for one in (made, changed))
            np.testing.assert_array_equal(found, expected)

    @pytest.mark.parametrize(
        ("values", "arm", "message"),
        [
            ({"translational_stiffness": 0.0}, None, "translational_stiffness = 0.0: .*greater than 0"),
            ({"translational_stiffness": -1.0}, None, "translational_stiffness = -1.0"),
            ({"translational_stiffness": 1e4}, None, "translational_stiffness = 10000.0: .*5000"),
            ({"rotational_stiffness": np.inf}, None, "rotational_stiffness = inf: .*finite"),
            ({"rotational_stiffness": np.nan}, None, "rotational_stiffness = nan"),
            ({"rotational_stiffness": True}, None, "rotational_stiffness = True"),
            ({"damping_ratio": 0.05}, None, "damping_ratio = 0.05: .*0.1"),
            ({"nullspace_stiffness": 10.0, "nullspace_damping_ratio": 3.0}, None, "nullspace_damping_ratio = 3.0"),
            ({"torque_scale": 0.5}, None, "torque_scale = 0.5: while a controller runs: translational_stiffness, "),
            ({"translational_stiffness": 100.0}, "middle", "no arm 'middle'; arms: left, right"),
        ],
    )
    def test_what_cannot_be_is_refused_and_nothing_changes(
        self, robot: Robot, values: dict, arm: str | None, message: str
    ) -> None:
        controller = ImpedanceController(robot)
        before = controller.in_force("left")
        with pytest.raises(ConfigError, match=message):
            controller.change(values, arm)
        controller.step(reference(robot.home), at(robot.home), DT)
        assert controller.in_force("left") == before


@pytest.mark.parametrize(("model", "joints"), [("panda", 7), ("ur5", 6)])
def test_robots_whose_rotors_are_unknown_have_usual_ones(model: str, joints: int) -> None:
    import example_robot_data

    loaded = example_robot_data.load(model)
    tool = {"panda": "panda_hand", "ur5": "tool0"}[model]
    robot = Robot.from_urdf(loaded.urdf, {"left": tool})
    np.testing.assert_array_equal(robot.model.armature, np.full(joints, 0.1))
    controller = ImpedanceController(robot)
    q = robot.home + 0.2
    controller.reset(at(q))
    np.testing.assert_allclose(controller.step(reference(q), at(q), DT).tau, gravity(robot, q), atol=1e-9)
