"""Velocity commands: they lead to the reference, within limits, and never from a measurement that is not trusted."""

from __future__ import annotations

import numpy as np
import pytest

from q2r2_control import Pipeline
from q2r2_control.drives.base import FEEDBACK_GAIN, VelocityDrive
from q2r2_control.inputs.scripted import ScriptedInput
from q2r2_control.types import CommandMode, Reference, RobotState, StepReport, StepStatus
from tests.support.watch import Watch, cell


@pytest.mark.parametrize("plant", ["kinematic", "mujoco"])
def test_in_velocity_mode_both_arms_follow_their_reference_within_every_limit(plant: str) -> None:
    config = cell().model_copy(update={"loop_rate_hz": 500.0})
    loop = Pipeline.from_config(config, input=ScriptedInput("circle", frequency_hz=0.5), plant=plant, mode="velocity")
    watch = Watch(loop)
    summary = loop.run(2.5, realtime=False)
    assert summary.at_rest
    for tick, after in zip(watch.ticks, watch.ticks[1:], strict=False):
        assert np.abs(after.state.q - tick.reference.q).max() < 0.02
    assert max(np.abs(tick.reference.v).max() for tick in watch.ticks) > 0.1
    error = summary.arms["left"].position_error_mm_rms
    assert error is not None
    assert error < 3.0
    rest = loop.plant.state().q
    loop.plant.advance(0.5)
    np.testing.assert_allclose(loop.plant.state().q, rest, atol=1e-3)


def at(q: np.ndarray, v: np.ndarray) -> Reference:
    return Reference(q, v, 0.0 * q, StepReport(StepStatus.OK, (), (), ("", ""), 1.0, True, False, 0.0, 0.0))


def test_the_feedback_is_bounded_and_left_out_where_the_state_is_not_trusted() -> None:
    loop = Pipeline.from_config(cell(), plant="kinematic", mode="velocity")
    drive, robot = loop.drive, loop.robot
    assert isinstance(drive, VelocityDrive)
    zero = np.zeros_like(robot.home)
    reference = at(robot.home, zero + 0.1)
    off = RobotState(robot.home - 0.01, zero, zero, None, 0.0)
    command = drive.command(reference, off, {}, 0.001)
    assert command.mode is CommandMode.VELOCITY
    np.testing.assert_allclose(command.v, 0.1 + 0.01 * FEEDBACK_GAIN)
    np.testing.assert_allclose(drive.command(reference, off, {}, 0.001, trusted=False).v, 0.1)
    far = RobotState(robot.home - 2.0, zero, zero, None, 0.0)
    np.testing.assert_allclose(drive.command(reference, far, {}, 0.001).v, robot.velocity_limit)
    last = drive.last_command(off, {})
    assert last is not None
    assert not last.v.any()
