"""The colours (r g b) of the states of an arm and of moving obstacles. They are the same on every display."""

from __future__ import annotations

from q2r2_control.config.moving_obstacle import ObstacleReport
from q2r2_control.control.safety.protective_distance import REPORT_AGE
from q2r2_control.teleop.arm_states import ArmState

Colour = tuple[int, int, int]
GREEN, AMBER, RED, BLUE, GREY = (46, 160, 90), (230, 160, 30), (214, 57, 57), (60, 120, 216), (140, 146, 152)
_COLOURS: dict[str, Colour] = {
    ArmState.ENGAGED: GREEN,
    ArmState.CARRIED: GREEN,
    ArmState.PAUSING: AMBER,
    ArmState.PAUSED: AMBER,
    ArmState.ALIGNING: AMBER,
    ArmState.HOMING: BLUE,
    ArmState.LOST: RED,
    ArmState.STOPPED: RED,
}


def state_colour(state: str) -> Colour:
    return _COLOURS.get(state, GREY)


def obstacle_colour(report: ObstacleReport) -> Colour:
    """Return RED if the obstacle may move and its report is so old that arms keep a larger distance; else AMBER."""
    return RED if report.obstacle.speed > 0.0 and report.age > REPORT_AGE else AMBER
