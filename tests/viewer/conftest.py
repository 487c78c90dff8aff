"""A tick of a run, for tests of the tables, pages and sentences about a run."""

from __future__ import annotations

import numpy as np
import pinocchio as pin

from q2r2_control.drives.base import position_command
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import RunStart, Tick
from q2r2_control.types import ArmTarget, Reference, RobotState, StepReport, StepStatus


def tick_at(robot: Robot, t: float, distance: float = 0.1, engaged: bool = True) -> Tick:
    """Return a tick at time ``t`` [s] whose tools are 3 mm and 0.1 rad from their targets, if ``engaged``.

    The nearest pair is ``distance`` [m] apart. Another pair has the smallest margin: ``distance`` - 18 mm.
    """
    zero = np.zeros(len(robot.joint_names))
    hand, arms = ("left_hand_0", "table_0"), ("left_link_5_0", "right_link_5_0")
    report = StepReport(StepStatus.OK, (), (), hand, distance, True, False, 0.0, 0.0, arms, distance - 0.018)
    tools = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
    offset = pin.SE3(pin.exp3(np.array([0.0, 0.1, 0.0])), np.array([0.003, 0.0, 0.0]))
    state, reference = RobotState(robot.home, zero, zero, None, t), Reference(robot.home, zero, zero, report)
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
        reference=reference,
        state=state,
        openings=dict.fromkeys(robot.arms, 0.5),
        tools=tools,
        command=position_command(reference, {}),
        events=[],
        grippers=dict.fromkeys(robot.arms, 0.5),
        compute_time=1e-4,
    )
