"""What the plots are drawn from: no peak lost, and never more than a bounded number of rows."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest

from q2r2_control.config.cell import load_config
from q2r2_control.drives.base import position_command
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import RunStart, Tick
from q2r2_control.types import ArmTarget, Reference, RobotState, StepReport, StepStatus
from q2r2_control.viewer.history import History


@pytest.fixture(scope="module")
def robot() -> Robot:
    return Robot.from_config(load_config("config/dual_iiwa7.yaml"))


def tick_at(robot: Robot, t: float, acceleration: float = 0.0, distance: float = 0.1, engaged: bool = True) -> Tick:
    """A tick whose tools are 3 mm and 0.1 rad from their targets; the tightest pair keeps 20 mm, the nearest one 0."""
    zero = np.zeros(len(robot.joint_names))
    hand, arms = ("left_hand_0", "table_0"), ("left_link_5_0", "right_link_5_0")
    report = StepReport(StepStatus.OK, (), (), hand, distance, True, False, 0.0, 0.0, arms, distance - 0.018)
    tools = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    offset = pin.SE3(pin.exp3(np.array([0.0, 0.1, 0.0])), np.array([0.003, 0.0, 0.0]))
    state = RobotState(robot.home, zero, zero, None, t)
    return Tick(
        t=t,
        start=RunStart(0.0, state),
        now=t,
        dt=0.001,
        step=0.001,
        following=True,
        connected=True,
        samples=[],
        targets={arm: ArmTarget(pose * offset if engaged else None, 1.0) for arm, pose in tools.items()},
        engaged=dict.fromkeys(robot.arms, engaged),
        states=dict.fromkeys(robot.arms, "engaged" if engaged else "paused"),
        reference=Reference(robot.home, zero, zero + acceleration, report),
        state=state,
        openings=dict.fromkeys(robot.arms, 0.5),
        tools=tools,
        command=position_command(Reference(robot.home, zero, zero, report), {}),
        events=[],
        grippers=dict.fromkeys(robot.arms, 0.5),
        compute_time=1e-4,
    )


LIMIT = np.linspace(10.0, 20.0, 14)  # [rad/s^2]


def test_peaks_between_rows_are_kept_however_long_the_run_and_rows_stay_bounded(robot: Robot) -> None:
    history = History(robot, LIMIT, max_rows=50)
    calm, peak = tick_at(robot, 0.0), tick_at(robot, 0.0, acceleration=-7.0, distance=0.021)
    for index in range(20_000):
        history(replace(peak if index in (1234, 15_001) else calm, t=1e-3 * index))
    rows = history.rows
    assert 25 <= len(rows) <= 50
    assert np.all(np.diff(rows["t"]) > 0.0)
    assert rows["t"][-1] > 19.0
    for index in (1234, 15_001):
        row = rows[int(np.searchsorted(rows["t"], 1e-3 * index))]
        assert row["acceleration_ratio"] == pytest.approx(0.7)
        assert row["margin"] == pytest.approx(0.003)
    assert (rows["acceleration_ratio"] > 0.0).sum() == 2


@pytest.mark.parametrize("engaged", [True, False])
def test_a_row_has_the_tools_and_of_arms_that_are_engaged_targets_and_errors(robot: Robot, engaged: bool) -> None:
    history = History(robot, LIMIT)
    history(tick_at(robot, 0.0, engaged=engaged))
    (row,) = history.rows
    np.testing.assert_allclose(row["q"], robot.home)
    np.testing.assert_allclose(row["right"]["tool"], robot.tool_pose(robot.home, "right").translation)
    assert (row["left"]["gripper"], row["left"]["engaged"]) == (0.5, float(engaged))
    expected = (0.003, 0.1) if engaged else (np.nan, np.nan)
    np.testing.assert_allclose([row["left"]["position_error"], row["left"]["rotation_error"]], expected)
    assert np.isnan(row["left"]["target"]).all() == (not engaged)
