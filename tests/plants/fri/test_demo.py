"""The demo with two cabinets in virtual time. The cabinets' simulation measures the tasks."""

from __future__ import annotations

import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.demo.assembly_tasks import TaskWatch, tasks_named
from q2r2_control.inputs.scripted import ScriptedInput, trajectory_named
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.fri.cabinet_server import SimulatedArms, settings_of
from q2r2_control.plants.fri.wire import CommandKind
from q2r2_control.robot.robot import Robot
from q2r2_control.types import SIDES, CommandMode
from tests.plants.fri.virtual_cabinets import VirtualCabinets


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "period"),
    [pytest.param("handover", 0.005, id="every 5 ms"), pytest.param("stack", 0.002, id="every 2 ms")],
)
def test_a_task_succeeds_through_cabinets_with_a_jittering_network(name: str, period: float) -> None:
    config = load_config("config/dual_iiwa7_fri.yaml")
    robot = Robot.from_config(config)
    arms = SimulatedArms(robot, config)
    settings = {str(arm): settings_of(robot, arm, CommandKind.POSITION, 2, period) for arm in SIDES}
    grippers = {str(arm): its.gripper for arm, its in config.fri.items() if isinstance(its.gripper, GripperIoConfig)}
    plant = VirtualCabinets(
        robot,
        settings,
        robot.home,
        1.0 / config.nominal_rate_hz,
        config.control.max_substep,
        jitter=0.0005,
        arms=arms,
        grippers=grippers,
    )
    for cabinet in plant.cabinets.values():
        cabinet.start_overlay()
    pipeline = Pipeline(config, robot, ScriptedInput(name), plant, CommandMode.POSITION)
    tasks = TaskWatch(tasks_named([name]), arms.plant, robot, config)
    pipeline.listeners.append(tasks)
    summary = pipeline.run(trajectory_named(name).duration, realtime=False)
    assert {result.name: result.reason for result in tasks.results()} == {name: ""}
    assert [trip for cabinet in plant.cabinets.values() for trip in cabinet.trips] == []
    assert sum(cabinet.missed for cabinet in plant.cabinets.values()) == 0
    for arm in summary.arms.values():
        assert arm.position_error_mm_rms is not None
        assert arm.position_error_mm_rms < 1.0
