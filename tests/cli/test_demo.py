"""What the demo shows: both arms pick up their block, meet in the middle, and put it back."""

from __future__ import annotations

import numpy as np

from q2r2_control.config import Config, load_config
from q2r2_control.inputs.factory import DEFAULT_TRAJECTORY
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline import Pipeline
from q2r2_control.plants.mujoco import MujocoPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.runtime.recorder import Tick
from q2r2_control.types import Array, CommandMode
from tests.support.watch import assert_torque_bounds

BLOCKS = {"left": "blue_block", "right": "yellow_block"}


def coarse() -> Config:
    """The demo's cell, with the control loop slowed down: nothing here needs 1 kHz, and the test has to be fast."""
    config = load_config("config/dual_iiwa7.yaml")
    control = config.control.model_copy(update={"max_substep": 0.005})
    return config.model_copy(update={"loop_rate_hz": 200.0, "control": control})


class BlockWatch:
    """Where the blocks are at every tick."""

    def __init__(self, plant: MujocoPlant) -> None:
        self._plant = plant
        self.t: list[float] = []
        self.blocks: dict[str, list[Array]] = {arm: [] for arm in BLOCKS}
        self.ticks: list[Tick] = []

    def __call__(self, tick: Tick) -> None:
        self.ticks.append(tick)
        for arm, block in BLOCKS.items():
            self.blocks[arm].append(self._plant.data.body(block).xpos.copy())


def test_both_arms_pick_up_their_block_meet_in_the_middle_and_put_it_back() -> None:
    config = coarse()
    robot = Robot.from_config(config)
    plant = MujocoPlant(robot, config)
    pipeline = Pipeline(config, robot, ScriptedInput(DEFAULT_TRAJECTORY), plant, CommandMode.TORQUE)
    watch = BlockWatch(plant)
    pipeline.listeners.append(watch)
    summary = pipeline.run(20.0, realtime=False)

    t = np.array([tick.t for tick in watch.ticks])
    held = (t > 7.5) & (t < 13.5)
    for arm, places in watch.blocks.items():
        block = np.array(places)
        tool = np.array([tick.tools[arm].translation for tick in watch.ticks])
        assert block[held, 2].min() > 0.37
        assert np.linalg.norm((block - tool)[held], axis=1).max() < 0.02
        np.testing.assert_allclose(block[-1], block[0], atol=3e-3)
        error = summary.arms[arm].position_error_mm_rms
        assert error is not None
        assert error < 1.0
        assert summary.arms[arm].gripper_changes == 2
    assert_torque_bounds(pipeline, watch.ticks)
    reports = [tick.reference.report for tick in watch.ticks]
    meeting = (t > 10.0) & (t < 11.3)
    assert min(report.margin for report in reports) >= 0.0
    assert min(report.closest_distance for report in np.array(reports)[meeting]) < 0.04
    assert summary.fallback_ticks == 0
