"""The impedance controller without a simulator: its torques, its bounds, and its response to invalid numbers."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.compliance.impedance import ImpedanceController
from q2r2_control.config.control import LIVE_IMPEDANCE, ImpedanceSettings
from q2r2_control.errors import ConfigError, RobotError
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, RobotState
from tests.support.torque_loop import reference

DT = 0.001
SETTINGS = ImpedanceSettings(torque_rate_limit=1000.0)  # The limit is 1 Nm per tick.
STRETCHED = np.zeros(14)


def at(q: Array, v: Array | None = None) -> RobotState:
    return RobotState(q, np.zeros_like(q) if v is None else v, np.zeros_like(q), None, 0.0)


def gravity(robot: Robot, q: Array) -> Array:
    return np.array(pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q))


def started(robot: Robot, settings: ImpedanceSettings = SETTINGS) -> ImpedanceController:
    """Return a controller that was reset at home."""
    controller = ImpedanceController(robot, settings)
    controller.reset(at(robot.home))
    return controller


KEYS = (*LIVE_IMPEDANCE, "limit_stiffness", "limit_damping", "torque_scale", "torque_rate_limit", "ramp_time")


@pytest.mark.parametrize("key", KEYS)
@pytest.mark.parametrize("value", [0.0, np.nan])
def test_impedance_settings_that_would_not_hold_the_arm_are_refused(key: str, value: float) -> None:
    with pytest.raises(ConfigError, match=key):
        ImpedanceSettings.model_validate({key: value})


class TestController:
    @pytest.mark.parametrize("scale", [1.0, 0.5])
    def test_the_first_torque_is_the_gravity_torque_at_the_measured_posture(self, robot: Robot, scale: float) -> None:
        controller = ImpedanceController(robot, ImpedanceSettings(torque_scale=scale))
        q = robot.home + 0.1
        controller.reset(at(q))
        # The newest reference does not matter, because it is due only at the end of the tick.
        command = controller.step(reference(q + 0.2), at(q), DT)
        np.testing.assert_allclose(command.tau, gravity(robot, q), atol=1e-9)
        assert not command.report.held
        assert command.report.clipped == ()

    def test_an_extra_torque_is_added_and_the_sum_of_all_torques_is_bounded(self, robot: Robot) -> None:
        controller = started(robot)
        extra = np.zeros(14)
        extra[0], extra[5] = 0.5, 1e6
        command = controller.step(reference(robot.home), at(robot.home), DT, extra)
        added = command.tau - gravity(robot, robot.home)
        np.testing.assert_allclose(added[[0, 5]], [0.5, 1.0], atol=1e-9)
        assert command.report.saturated == command.report.rate_limited == ("left_A6",)
        assert controller.step(reference(robot.home), at(robot.home), DT, np.full(14, np.nan)).report.held

    def test_the_report_names_arms_whose_error_is_clipped_and_joints_that_are_pushed_away_from_a_limit(
        self, robot: Robot
    ) -> None:
        controller, q = started(robot), robot.home.copy()
        q[:7] += 0.6
        report = controller.step(reference(robot.home), at(q), DT).report
        assert report.clipped == ("left",)
        assert np.linalg.norm(report.errors["left"][:3]) == pytest.approx(0.1)
        assert np.linalg.norm(report.errors["right"]) == pytest.approx(0.0, abs=1e-12)
        q = robot.home.copy()
        q[9] = robot.position_upper[9] - 0.02
        assert controller.step(reference(robot.home), at(q), DT).report.repelled == ("right_A3",)

    @pytest.mark.parametrize("field", ["q", "v"])
    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_if_a_state_is_unusable_the_gravity_torque_of_the_last_state_is_held_and_the_fault_is_reported(
        self, robot: Robot, field: str, value: float
    ) -> None:
        controller, good, q = started(robot), at(robot.home), robot.home + 0.05
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

    def test_later_changes_of_given_arrays_change_nothing_in_the_controller(self, robot: Robot) -> None:
        controller = ImpedanceController(robot, SETTINGS)
        state, newest = at(robot.home.copy()), reference(robot.home.copy())
        controller.reset(state)
        command = controller.step(newest, state, DT)
        for array in (state.q, newest.q, command.tau):
            array[:] = np.nan
        command = controller.step(reference(robot.home), at(robot.home), DT)
        np.testing.assert_allclose(command.tau, gravity(robot, robot.home), atol=1e-9)

    @pytest.mark.parametrize("magnitude", [1e10, 1e300])
    def test_absurd_numbers_lead_to_bounded_torque(self, robot: Robot, magnitude: float) -> None:
        controller = started(robot)
        last = gravity(robot, robot.home)
        for sign in (1.0, -1.0):
            for absurd in (at(robot.home, sign * magnitude + STRETCHED), at(sign * magnitude + STRETCHED)):
                with np.errstate(all="ignore"):
                    tau = controller.step(reference(robot.home), absurd, DT).tau
                assert np.isfinite(tau).all()
                assert (np.abs(tau - last) <= 1.0 + 1e-9).all()
                last = tau

    @pytest.mark.parametrize("value", [np.nan, np.inf])
    def test_an_unusable_reference_is_not_used_and_the_last_reference_is_held(self, robot: Robot, value: float) -> None:
        controller = started(robot)
        moved = at(robot.home + 0.01)
        for _ in range(50):
            expected = controller.step(reference(robot.home), moved, DT).tau
        bad = STRETCHED + value
        for broken in (reference(bad), reference(robot.home, v=bad), reference(robot.home, a=bad)):
            command = controller.step(broken, moved, DT)
            np.testing.assert_allclose(command.tau, expected, atol=1e-9)
            assert not command.report.held

    @pytest.mark.parametrize(("dt", "change"), [(0.0, 0.0), (-1.0, 0.0), (np.nan, 0.0), (0.01, 10.0), (50.0, 100.0)])
    def test_the_torque_changes_by_at_most_the_rate_limit_times_dt(
        self, robot: Robot, dt: float, change: float
    ) -> None:
        controller = started(robot)
        tau = controller.step(reference(robot.home), at(robot.home), dt, np.full(14, 1e4)).tau
        expected = np.minimum(gravity(robot, robot.home) + change, robot.torque_limit)
        np.testing.assert_allclose(tau, expected, atol=1e-9)

    @pytest.mark.parametrize("bad", [np.full(14, np.nan), np.zeros(7)], ids=["NaN", "one arm"])
    def test_a_start_at_an_unusable_posture_is_refused(self, robot: Robot, bad: Array) -> None:
        with pytest.raises(RobotError, match="expected 14 finite numbers"):
            ImpedanceController(robot).reset(at(bad))


class TestAnImpedanceThatChanges:
    def test_a_setting_changes_linearly_over_the_ramp_time(self, robot: Robot) -> None:
        controller = started(robot, ImpedanceSettings(ramp_time=0.1))
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

    def test_a_second_change_of_a_setting_starts_from_its_present_value_and_affects_no_other_change(
        self, robot: Robot
    ) -> None:
        controller = started(robot, ImpedanceSettings(ramp_time=0.1))
        controller.change({"damping_ratio": 0.5, "nullspace_stiffness": 10.0})
        for ticks, damping in ((50, None), (50, [1.25, 0.5]), (50, [1.75, 0.5])):
            for _ in range(ticks):
                controller.step(reference(robot.home), at(robot.home), DT)
            if damping is None:
                controller.change({"damping_ratio": 1.75}, arm="left")
                continue
            in_force = [controller.in_force(arm) for arm in ("left", "right")]
            assert [values["damping_ratio"] for values in in_force] == pytest.approx(damping)
            assert [values["nullspace_stiffness"] for values in in_force] == pytest.approx([10.0, 10.0])

    def test_after_a_change_torques_equal_the_torques_of_a_controller_that_was_made_with_the_new_settings(
        self, robot: Robot
    ) -> None:
        soft = {"translational_stiffness": 300.0, "damping_ratio": 0.4, "nullspace_stiffness": 20.0}
        made, changed = started(robot, ImpedanceSettings(**soft)), ImpedanceController(robot)
        changed.change(soft)
        changed.reset(at(robot.home))
        random = np.random.default_rng(2)
        for _ in range(50):
            q, v = robot.home + random.normal(0.0, 0.02, 14), random.normal(0.0, 0.1, 14)
            expected, found = (one.step(reference(robot.home), at(q, v), DT).tau for one in (made, changed))
            np.testing.assert_array_equal(found, expected)

    @pytest.mark.parametrize(
        ("values", "arm", "message"),
        [
            ({"translational_stiffness": 0.0}, None, "translational_stiffness = 0.0: .*more than 0"),
            ({"translational_stiffness": 1e4}, None, "translational_stiffness = 10000.0: .*5000"),
            ({"rotational_stiffness": np.nan}, None, "rotational_stiffness = nan"),
            ({"rotational_stiffness": True}, None, "rotational_stiffness = True"),
            ({"nullspace_stiffness": 10.0, "nullspace_damping_ratio": 3.0}, None, "nullspace_damping_ratio = 3.0"),
            ({"torque_scale": 0.5}, None, "torque_scale = 0.5: while a controller runs: translational_stiffness, "),
            ({"translational_stiffness": 100.0}, "middle", "no arm 'middle'; arms: left, right"),
        ],
    )
    def test_a_setting_that_is_not_allowed_is_refused_and_nothing_changes(
        self, robot: Robot, values: dict, arm: str | None, message: str
    ) -> None:
        controller = ImpedanceController(robot)
        before = controller.in_force("left")
        with pytest.raises(ConfigError, match=message):
            controller.change(values, arm)
        controller.step(reference(robot.home), at(robot.home), DT)
        assert controller.in_force("left") == before


@pytest.mark.slow
@pytest.mark.parametrize(("model", "tool", "joints"), [("panda", "panda_hand", 7), ("ur5", "tool0", 6)])
def test_robots_with_unknown_rotor_inertias_get_usual_rotor_inertias(model: str, tool: str, joints: int) -> None:
    import example_robot_data

    robot = Robot.from_urdf(example_robot_data.load(model).urdf, {"left": tool})
    np.testing.assert_array_equal(robot.model.armature, np.full(joints, 0.1))
    controller = ImpedanceController(robot)
    q = robot.home + 0.2
    controller.reset(at(q))
    np.testing.assert_allclose(controller.step(reference(q), at(q), DT).tau, gravity(robot, q), atol=1e-9)
