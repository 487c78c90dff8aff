"""How the simulated cell of ``mujoco_robot`` moves between two commands. The tests set its clock."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from q2r2_control.config.cell import Config
from q2r2_control.plants.simulated_cell import JointFollower, SimulatedCell

HOLD_AFTER = 0.1  # [s]


@pytest.fixture
def cell(robot: Robot, config: Config) -> SimulatedCell:
    return SimulatedCell(robot, config, hold_after=HOLD_AFTER, max_jump=0.1)


def push(cell: SimulatedCell, now: float) -> None:
    """Command torques that hold the arms against gravity and turn one joint."""
    robot = cell.robot
    tau = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), cell.plant.state().q)
    tau[5] += 5.0
    assert cell.command_torques(tau, now) is None


@pytest.mark.parametrize("late", [0.02, 0.05, 0.09])
def test_a_torque_that_is_not_renewed_acts_for_about_12_milliseconds(cell: SimulatedCell, late: float) -> None:
    cell.advance(0.0)
    push(cell, 0.0)
    for now in np.arange(0.004, late, 0.004):
        cell.advance(now)
    assert cell.mode(late) == "torque"
    assert cell.plant.data.time == pytest.approx(0.012, abs=0.005)
    push(cell, late)
    cell.advance(late + 0.004)
    assert cell.plant.data.time == pytest.approx(0.016, abs=0.005)
    assert cell.dropped == pytest.approx(late - 0.012, abs=0.005)


def test_an_old_torque_does_not_act_for_the_whole_time_of_a_late_call(cell: SimulatedCell) -> None:
    cell.advance(0.0)
    push(cell, 0.0)
    cell.advance(0.05)
    assert cell.plant.data.time <= 0.012 + 1e-9


def test_servos_hold_the_arms_if_no_torques_come_for_a_tenth_of_a_second(cell: SimulatedCell) -> None:
    cell.advance(0.0)
    push(cell, 0.0)
    for now in np.arange(0.004, 1.0, 0.004):
        cell.advance(now)
    assert cell.mode(1.0) == "holding"
    assert np.abs(cell.plant.state().v).max() < 1e-3
    assert cell.plant.data.time == pytest.approx(1.0 - HOLD_AFTER + 0.012, abs=0.01)


LIMIT, ACCELERATION = np.array([1.5, 2.0]), np.array([10.0, 4.0])
JOINTS, DT = np.array([0, 1]), 0.001


def motion(t: float) -> tuple[np.ndarray, np.ndarray]:
    """Return posture and velocity of a smooth motion from rest."""
    return np.array([0.5 * (1 - np.cos(t)), t**2 / 10]), np.array([0.5 * np.sin(t), t / 5])


@pytest.mark.parametrize("with_velocity", [True, False])
@pytest.mark.parametrize("period", [0.002, 0.004, 0.02])
def test_the_cell_follows_a_motion_whose_commands_come_unevenly(with_velocity: bool, period: float) -> None:
    random = np.random.default_rng(3)
    follower = JointFollower(np.zeros(2), ACCELERATION, LIMIT)
    due = np.arange(0.0, 2.0, period) + random.uniform(0.0, 0.3 * period, len(np.arange(0.0, 2.0, period)))
    newest = 0
    for tick in range(1, 2000):
        now = tick * DT
        while newest < len(due) and due[newest] <= now:
            q, v = motion(due[newest])
            follower.command(JOINTS, q, v if with_velocity else None, due[newest])
            newest += 1
        before = follower.q
        follower.advance(now, DT)
        assert (np.abs(follower.q - before) <= LIMIT * DT * (1 + 1e-9)).all()
        if now > 0.3:
            assert np.abs(follower.q - motion(now)[0]).max() < (0.001 if with_velocity else 0.4 * period + 0.001)


def test_without_commands_the_cell_keeps_its_last_velocity_for_a_short_time_and_then_brakes() -> None:
    follower = JointFollower(np.zeros(2), ACCELERATION, LIMIT)
    v = np.array([1.0, -2.0])
    for tick in range(100):
        follower.command(JOINTS, v * tick * DT, v, tick * DT)
        follower.advance(tick * DT, DT)
    last = 99 * DT
    for tick in range(100, 700):
        before_q, before_v = follower.q, follower.v
        follower.advance(tick * DT, DT)
        if tick * DT - last <= 0.01:
            continue
        assert (np.abs(follower.v - before_v) <= ACCELERATION * DT * (1 + 1e-9)).all()
        assert np.allclose(follower.q - before_q, 0.5 * (follower.v + before_v) * DT)
        rests = tick * DT - last > 0.03 + np.abs(v) / ACCELERATION
        assert not follower.v[rests].any()
        assert rests[1] or tick * DT - last > 0.45 or follower.v[1] != 0.0, "brakes at its own limit, not faster"
    assert not follower.v.any()


def test_a_command_may_name_only_some_joints_and_the_other_joints_do_not_move() -> None:
    follower = JointFollower(np.array([0.1, 0.2]), ACCELERATION, LIMIT)
    for tick in range(100):
        follower.command(np.array([1]), np.array([0.25]), np.zeros(1), tick * DT)
        follower.advance(tick * DT, DT)
    assert follower.q.tolist() == pytest.approx([0.1, 0.25])
