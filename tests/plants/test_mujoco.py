from __future__ import annotations

from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.errors import PlantError
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState
from tests.plants.conftest import hold, tool_motion

DT = 0.001


def _gravity(robot: Robot, q: Array) -> Array:
    torque: Array = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), q)
    return torque


def _torque_command(tau: Array) -> Command:
    return Command(CommandMode.TORQUE, np.zeros_like(tau), np.zeros_like(tau), tau, {})


def _block_height(plant: MujocoPlant) -> float:
    return float(plant.data.body("block").xpos[2])


def _external(state: RobotState) -> Array:
    assert state.tau_external is not None
    return state.tau_external


def _same(first: RobotState, second: RobotState) -> bool:
    return (
        first.stamp == second.stamp
        and np.array_equal(first.q, second.q)
        and np.array_equal(first.v, second.v)
        and np.array_equal(first.tau, second.tau)
        and np.array_equal(_external(first), _external(second))
    )


class TestPositionMode:
    def test_the_arms_stay_at_home_against_gravity_until_the_first_command(
        self, plant: MujocoPlant, robot: Robot
    ) -> None:
        for _ in range(1000):
            np.testing.assert_allclose(plant.state().tau, _gravity(robot, robot.home), atol=0.01)
            plant.advance(DT)
            np.testing.assert_allclose(plant.state().q, robot.home, atol=1e-3)
        np.testing.assert_allclose(plant.state().v, 0, atol=1e-6)

    @pytest.mark.parametrize("dt", [0.0013, 0.01])
    def test_the_tool_follows_at_0_3_m_s_within_a_millimetre(self, plant: MujocoPlant, robot: Robot, dt: float) -> None:
        for command in tool_motion(robot, "left", np.array([0.2, -0.1, 0.2]), 0.8, dt, robot.home):
            plant.apply(command)
            plant.advance(dt)
            reached, due = (robot.tool_pose(q, "left").translation for q in (plant.state().q, command.q))
            assert np.linalg.norm(reached - due) < 1e-3

    def test_torque_stays_inside_the_limits_if_the_reference_jumps(self, plant: MujocoPlant, robot: Robot) -> None:
        rng = np.random.default_rng(3)
        saturated = np.zeros(14, dtype=bool)
        for _ in range(60):
            v = rng.uniform(-5, 5, 14)
            plant.apply(replace(hold(rng.uniform(robot.position_lower, robot.position_upper)), v=v))
            for _ in range(5):
                plant.advance(DT)
                state = plant.state()
                assert (np.abs(state.tau) <= robot.torque_limit * (1 + 1e-12)).all()
                assert np.isfinite(state.q).all()
                saturated |= np.abs(state.tau) >= robot.torque_limit * (1 - 1e-12)
        assert saturated.all()

    def test_an_arm_rests_at_the_last_commanded_position_if_no_newer_command_comes(
        self, plant: MujocoPlant, robot: Robot
    ) -> None:
        commands = list(tool_motion(robot, "left", np.array([0.0, 0.0, 0.2]), 0.8, DT, robot.home))[:400]
        for command in commands:
            plant.apply(command)
            plant.advance(DT)
        for _ in range(1000):
            plant.advance(DT)
        np.testing.assert_allclose(plant.state().q, commands[-1].q, atol=1e-4)
        np.testing.assert_allclose(plant.state().v, 0, atol=1e-4)


class TestTorqueMode:
    def test_a_position_command_at_the_measured_posture_stops_the_arm(self, plant: MujocoPlant, robot: Robot) -> None:
        plant.apply(_torque_command(np.zeros(14)))
        plant.advance(0.05)
        measured = plant.state().q
        plant.apply(hold(measured))
        plant.advance(0.8)
        np.testing.assert_allclose(plant.state().q, measured, atol=1e-4)


class TestPush:
    def test_the_measured_external_torques_are_the_joint_torques_of_the_push(
        self, plant: MujocoPlant, robot: Robot
    ) -> None:
        wrench = np.array([10.0, -20.0, 30.0, 1.0, 2.0, -3.0])
        plant.push("left", wrench, 0.5)
        plant.advance(0.4)
        state = plant.state()
        data, arm = robot.model.createData(), robot.arms["left"]
        pin.computeJointJacobians(robot.model, data, state.q)
        jacobian = pin.getFrameJacobian(robot.model, data, arm.frame_id, pin.LOCAL_WORLD_ALIGNED)
        np.testing.assert_allclose(_external(state), jacobian.T @ wrench, atol=0.05)
        plant.advance(0.4)
        np.testing.assert_allclose(_external(plant.state()), 0, atol=1e-9)

    def test_a_push_lasts_for_its_duration_to_within_one_step(self, plant: MujocoPlant) -> None:
        plant.push("left", np.array([50.0, 0, 0, 0, 0, 0]), 0.003)
        felt = []
        for _ in range(5):
            plant.advance(DT)
            felt.append(bool(np.abs(_external(plant.state())).max() > 1))
        assert felt == [True, True, True, False, False]

    @pytest.mark.parametrize(
        ("arm", "wrench", "duration"),
        [
            pytest.param("middle", np.zeros(6), 1.0, id="no such arm"),
            pytest.param("left", np.full(6, np.nan), 1.0, id="NaN"),
            pytest.param("left", np.zeros(3), 1.0, id="no torque"),
            pytest.param("left", np.zeros(6), float("inf"), id="for ever"),
        ],
    )
    def test_a_bad_push_is_refused(self, plant: MujocoPlant, arm: str, wrench: Array, duration: float) -> None:
        with pytest.raises(PlantError, match="push"):
            plant.push(arm, wrench, duration)


class TestGripper:
    def test_both_fingers_move_alike_at_the_configured_speed(self, plant: MujocoPlant, robot: Robot) -> None:
        plant.apply(hold(robot.home, left=0.0))
        fingers = [plant.data.joint(f"left_finger_joint_{index}") for index in (1, 2)]
        for tick in range(1, 251):
            plant.advance(DT)
            first, second = (float(finger.qpos[0]) for finger in fingers)
            assert first == pytest.approx(second, abs=1e-4)
            assert first == pytest.approx(0.025 - 0.1 * tick * DT, abs=1.5e-3)
        plant.advance(0.1)
        assert plant.gripper_openings()["left"] == pytest.approx(0, abs=0.01)
        assert plant.gripper_openings()["right"] == pytest.approx(1, abs=0.01)

    def test_the_gripper_grasps_lifts_and_drops_a_block_as_configured(
        self, grasping_plant: MujocoPlant, robot: Robot
    ) -> None:
        plant = grasping_plant
        plant.apply(hold(robot.home, left=0.0))
        for _ in range(500):
            plant.advance(DT)
            for joint in ("left_finger_joint_1", "left_finger_joint_2"):
                assert abs(plant.data.joint(joint).qfrc_actuator[0]) <= 60.0 + 1e-9
        # A block of 40 mm stops the fingers, which open by 50 mm.
        assert plant.gripper_openings()["left"] == pytest.approx(0.8, abs=0.03)
        resting = _block_height(plant)
        grip = float(robot.tool_pose(plant.state().q, "left").translation[2]) - resting
        up = list(tool_motion(robot, "left", np.array([0.0, 0.0, 0.3]), 0.7, DT, robot.home))
        for command in chain(up, repeat(hold(up[-1].q), 500)):
            plant.apply(command)
            plant.advance(DT)
            tool = float(robot.tool_pose(plant.state().q, "left").translation[2])
            assert tool - _block_height(plant) == pytest.approx(grip, abs=2e-3)
        assert _block_height(plant) > resting + 0.1
        plant.apply(hold(up[-1].q, left=1.0))
        plant.advance(0.8)
        assert _block_height(plant) < resting + 0.01


class TestTime:
    @pytest.mark.slow
    @pytest.mark.parametrize("dt", [0.0001, 0.00037, 0.001, 0.0013, 1 / 60, 1 / 72])
    def test_the_stamp_of_a_state_differs_from_the_elapsed_time_by_less_than_a_step(
        self, plant: MujocoPlant, dt: float
    ) -> None:
        for tick in range(1, 301):
            plant.advance(dt)
            assert -1e-8 < tick * dt - plant.state().stamp < DT

    @pytest.mark.parametrize("dt", [float("nan"), float("inf"), -DT, 3600.0])
    def test_an_impossible_dt_raises_an_error_and_moves_nothing(
        self, plant: MujocoPlant, robot: Robot, dt: float
    ) -> None:
        before = plant.state()
        plant.apply(hold(robot.home + 0.1))
        plant.advance(0.0)
        with pytest.raises(PlantError, match=r"allowed: 0 \.\. 1 s"):
            plant.advance(dt)
        assert _same(plant.state(), before)


class TestRepeatability:
    @staticmethod
    def _run(plant: MujocoPlant, robot: Robot) -> list[RobotState]:
        plant.push("right", np.array([5.0, 3.0, -20.0, 0, 1.0, 0]), 0.2)
        states = []
        for index, command in enumerate(
            tool_motion(robot, "left", np.array([0.1, 0.0, -0.3]), 0.7, 0.0013, robot.home)
        ):
            plant.apply(replace(command, grippers={"left": float(index < 50), "right": 0.0}))
            plant.advance(0.0013)
            states.append(plant.state())
        return states

    def test_reset_restores_everything_and_ends_pushes(self, plant: MujocoPlant, robot: Robot, config: Config) -> None:
        plant.apply(_torque_command(np.zeros(14)))
        plant.push("left", np.array([50.0, 0, 0, 0, 0, 0]), 10.0)
        plant.advance(0.7)
        posture = robot.home + 0.05
        plant.reset(posture)
        state = plant.state()
        np.testing.assert_array_equal(state.q, posture)
        np.testing.assert_array_equal(state.v, 0)
        np.testing.assert_allclose(_external(state), 0, atol=1e-9)
        assert state.stamp == 0
        assert plant.gripper_openings() == {"left": 1.0, "right": 1.0}
        for name, thing in config.mujoco.objects.items():
            np.testing.assert_allclose(plant.data.body(name).xpos, thing.position)
        plant.advance(0.3)
        np.testing.assert_allclose(plant.state().q, posture, atol=1e-4)


def test_a_returned_state_does_not_change_later(plant: MujocoPlant, robot: Robot) -> None:
    state = plant.state()
    plant.apply(hold(robot.home + 0.05))
    plant.advance(0.2)
    np.testing.assert_array_equal(state.q, robot.home)


def test_a_block_at_rest_moves_when_an_arm_pushes_it(grasping_plant: MujocoPlant, robot: Robot) -> None:
    plant = grasping_plant
    plant.advance(1.0)
    before = float(plant.data.body("block").xpos[1])
    for command in tool_motion(robot, "left", np.array([0.0, 0.1, 0.0]), 0.6, DT, robot.home):
        plant.apply(command)
        plant.advance(DT)
    assert float(plant.data.body("block").xpos[1]) > before + 0.02


def test_a_diverged_simulation_raises_an_error_and_works_again_after_a_reset(plant: MujocoPlant, robot: Robot) -> None:
    plant.data.qvel[3] = np.nan
    with pytest.raises(PlantError, match="diverged"):
        plant.advance(DT)
    plant.reset()
    plant.advance(DT)
    np.testing.assert_allclose(plant.state().q, robot.home, atol=1e-9)
