"""Arms move alike whether the plant wraps the angles of endless joints to one turn, or counts their turns."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from q2r2_control.config.cell_file import load_config
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.pipeline.pipeline import Pipeline
from q2r2_control.plants.kinematic import KinematicPlant
from q2r2_control.robot.robot import Robot
from q2r2_control.types import RobotState


class WrappedPlant(KinematicPlant):
    """A plant that wraps the angles of endless joints to one turn, which ends 0.01 rad above the home posture."""

    def state(self) -> RobotState:
        state, end = super().state(), self._robot.home + 0.01
        within = end - np.remainder(end - state.q, 2.0 * np.pi)
        return replace(state, q=np.where(self._robot.endless, within, state.q))


@pytest.mark.slow
def test_arms_follow_hands_across_the_angle_at_which_the_reported_angles_wrap_around() -> None:
    config = load_config("config/dual_kinova.yaml").model_copy(update={"loop_rate_hz": 500.0})
    robot = Robot.from_config(config)
    plant = WrappedPlant(robot, config)
    pipeline = Pipeline(config, robot, ScriptedInput.from_config(config, "circle"), plant)
    jumps: list[float] = []
    pipeline.listeners.append(lambda tick: jumps.append(float(np.ptp(plant.state().q - tick.state.q))))
    summary = pipeline.run(2.8, realtime=False)
    assert max(jumps) > 6.0, "some joint crossed that angle"
    assert summary.at_rest
    for arm in summary.arms.values():
        assert arm.engaged_s > 1.0
        assert arm.position_error_mm_rms is not None
        assert arm.position_error_mm_rms < 10.0


class TurnedPlant(KinematicPlant):
    """A plant that reports endless joints one turn lower from the second report on."""

    reports = 0

    def state(self) -> RobotState:
        self.reports += 1
        state = super().state()
        return replace(state, q=state.q - 2.0 * np.pi * self._robot.endless * (self.reports > 1))


def test_a_turn_between_the_first_report_and_the_first_tick_is_counted_too() -> None:
    config = load_config("config/dual_kinova.yaml").model_copy(update={"loop_rate_hz": 500.0})
    robot = Robot.from_config(config)
    plant = TurnedPlant(robot, config)
    pipeline = Pipeline(config, robot, ScriptedInput.from_config(config, "circle"), plant)
    measured: list[np.ndarray] = []
    pipeline.listeners.append(lambda tick: measured.append(tick.state.q))
    pipeline.run(0.01, realtime=False)
    assert plant.reports > 1
    np.testing.assert_allclose(measured[0], robot.home, atol=1e-9)
