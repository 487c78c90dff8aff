"""The simulated cell behind a topic: what acts on it between two commands, by a made-up clock."""

from __future__ import annotations

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control import Robot
from q2r2_control.config.cell import Config
from q2r2_control.plants.simulated_cell import SimulatedCell

HOLD_AFTER = 0.1  # [s]


@pytest.fixture
def cell(robot: Robot, config: Config) -> SimulatedCell:
    return SimulatedCell(robot, config, hold_after=HOLD_AFTER, max_jump=0.1)


def push(cell: SimulatedCell, now: float) -> None:
    """A torque that bears the arms and turns one joint."""
    robot = cell.robot
    tau = pin.computeGeneralizedGravity(robot.model, robot.model.createData(), cell.plant.state().q)
    tau[5] += 5.0
    assert cell.command_torques(tau, now) is None


@pytest.mark.parametrize("late", [0.02, 0.05, 0.09])
def test_a_torque_that_is_not_renewed_acts_for_some_milliseconds_while_its_sender_is_waited_for(
    cell: SimulatedCell, late: float
) -> None:
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


def test_a_simulation_that_is_called_late_lets_no_old_torque_act_for_all_that_time(cell: SimulatedCell) -> None:
    cell.advance(0.0)
    push(cell, 0.0)
    cell.advance(0.05)
    assert cell.plant.data.time <= 0.012 + 1e-9


def test_after_a_time_without_torques_the_arms_stand_on_their_servos(cell: SimulatedCell) -> None:
    cell.advance(0.0)
    push(cell, 0.0)
    for now in np.arange(0.004, 1.0, 0.004):
        cell.advance(now)
    assert cell.mode(1.0) == "holding"
    assert np.abs(cell.plant.state().v).max() < 1e-3
    assert cell.plant.data.time == pytest.approx(1.0 - HOLD_AFTER + 0.012, abs=0.01)
