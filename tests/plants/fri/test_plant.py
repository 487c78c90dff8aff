"""The plant on real sockets, with a cabinet that sends its next message after the answer to the last one."""

from __future__ import annotations

import math
import socket
import threading

import numpy as np
import pytest

from q2r2_control.config.cell import Config
from q2r2_control.config.fri import ModbusGripperConfig
from q2r2_control.errors import ConfigError, PlantError
from q2r2_control.plants.fri.plant import FriPlant
from q2r2_control.plants.fri.wire import Session
from q2r2_control.robot.robot import Robot
from q2r2_control.types import CommandMode
from tests.plants.conftest import hold
from tests.plants.fri.conftest import PATIENCE
from tests.plants.fri.waiting_cabinets import waiting_cabinets
from tests.support.headset_server import eventually
from tests.support.robotiq_gripper import SimulatedGripper


@pytest.mark.slow
@pytest.mark.parametrize("version", [1, 2])
def test_the_sessions_of_both_cabinets_reach_commanding_while_the_arms_are_held(
    robot: Robot, fri_config: Config, version: int
) -> None:
    plant = FriPlant.from_config(robot, fri_config)
    with waiting_cabinets(robot, fri_config, version) as made:
        plant.reset()
        try:
            waited = threading.Event()
            for _ in range(int(PATIENCE / 0.01)):
                if all(cabinet.session is Session.COMMANDING_ACTIVE for cabinet in made.values()):
                    break
                waited.wait(0.01)
            assert all(cabinet.session is Session.COMMANDING_ACTIVE for cabinet in made.values())
            state = plant.state()
        finally:
            plant.close()
    np.testing.assert_allclose(state.q, robot.home)
    assert state.held is not None
    np.testing.assert_allclose(state.held, robot.home)


def test_a_modbus_gripper_gets_the_commanded_openings_and_its_opening_is_measured(
    robot: Robot, fri_config: Config
) -> None:
    with SimulatedGripper() as simulated:
        gripper = ModbusGripperConfig(modbus=f"127.0.0.1:{simulated.port}")
        left = fri_config.fri["left"].model_copy(update={"gripper": gripper})
        config = fri_config.model_copy(update={"fri": {**fri_config.fri, "left": left}})
        plant = FriPlant.from_config(robot, config)
        with waiting_cabinets(robot, config, 2):
            plant.reset()
            try:
                assert plant.gripper_openings() == {}, "before it is active"
                plant.apply(hold(robot.home, left=0.2, right=0.9))
                eventually(lambda: plant.gripper_openings() == {"left": pytest.approx(0.2, abs=0.003)})
            finally:
                plant.close()
        assert simulated.activations == 1


def test_without_a_cabinet_the_run_names_the_cabinet_and_its_address(robot: Robot, fri_config: Config) -> None:
    plant = FriPlant.from_config(robot, fri_config)
    plant.longest_wait = 0.1
    port = fri_config.fri["left"].port
    with pytest.raises(PlantError, match=f"left: no FRI message from cabinet 127.0.0.1 on port {port}; waited"):
        plant.reset()
    assert plant.is_released()


def test_a_stopped_wait_for_a_cabinet_says_so_and_releases_the_ports(robot: Robot, fri_config: Config) -> None:
    plant = FriPlant.from_config(robot, fri_config)
    plant.longest_wait, stopped = math.inf, iter((False, False, True))
    plant.begin(CommandMode.POSITION, lambda: next(stopped, True))
    with pytest.raises(PlantError, match=r"left: no FRI message .*; the wait was stopped after"):
        plant.reset()
    assert plant.is_released()


def test_a_port_that_another_program_uses_is_named(robot: Robot, fri_config: Config) -> None:
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind(("127.0.0.1", fri_config.fri["right"].port))
        with pytest.raises(PlantError, match=r"fri\.right\.port = \d+: cannot be bound"):
            FriPlant.from_config(robot, fri_config).reset()


def test_each_session_gets_the_torque_rate_limit_of_the_cell(robot: Robot, fri_config: Config) -> None:
    impedance = fri_config.impedance.model_copy(update={"torque_rate_limit": 7000.0})
    lines = FriPlant.from_config(robot, fri_config.model_copy(update={"impedance": impedance}))._lines()
    for line in lines:
        socket.close(line.file)
    assert {line.session._torque_rate_limit for line in lines} == {7000.0}


def test_an_arm_without_a_cabinet_is_named(robot: Robot, config: Config) -> None:
    with pytest.raises(ConfigError, match=r"fri\.left: missing"):
        FriPlant.from_config(robot, config)


def test_a_max_substep_that_would_split_a_late_tick_is_refused(robot: Robot, fri_config: Config) -> None:
    config = fri_config.model_copy(update={"loop_rate_hz": 500.0})
    with pytest.raises(ConfigError, match=r"control\.max_substep = 0\.002: allowed with cabinets: two ticks"):
        FriPlant.from_config(robot, config)


def test_simulated_time_is_refused(robot: Robot, fri_config: Config) -> None:
    from q2r2_control.inputs.scripted import ScriptedInput
    from q2r2_control.pipeline.pipeline import Pipeline

    pipeline = Pipeline(fri_config, robot, ScriptedInput("circle"), FriPlant.from_config(robot, fri_config))
    with pytest.raises(ConfigError, match="simulated time"):
        pipeline.run(1.0, realtime=False)
