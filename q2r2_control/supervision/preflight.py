"""The checks of a cell before its arms move."""

from __future__ import annotations

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.kept_distances import kept_distances, too_close_at_home
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import joints_that_cannot_hold
from q2r2_control.robot.unchecked import unchecked_faults
from q2r2_control.robot.urdf_forms import LARGEST_ANGLE, LARGEST_SPEED

_NARROWEST = 1e-3  # The margins must leave each joint at least this range, which contains its home [rad or m].


def joints_in_degrees(robot: Robot) -> list[int]:
    """Return the indices of the joints whose limits are in degrees instead of radians."""
    farthest = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    # If the position limit and the speed limit of a joint are both too large, they are in degrees.
    turned = (farthest > LARGEST_ANGLE) & (farthest <= np.rad2deg(LARGEST_ANGLE))
    return np.flatnonzero(turned & (robot.velocity_limit > LARGEST_SPEED)).tolist()


def _in_degrees(robot: Robot) -> list[str]:
    """Return one line if joint limits are in degrees instead of radians; otherwise an empty list."""
    if not (found := joints_in_degrees(robot)):
        return []
    names = ", ".join(robot.joint_names[i] for i in found)
    lower, upper, fastest = (
        limits[found[0]] for limits in (robot.position_lower, robot.position_upper, robot.velocity_limit)
    )
    limits = f"{lower:g} .. {upper:g} rad and {fastest:g} rad/s"
    return [f"{names}: limits such as {limits} are degrees; allowed in a URDF: radians and radians per second"]


def preflight_faults(
    robot: Robot, settings: ControllerSettings, controller: CartesianController | None
) -> tuple[str, ...]:
    """Return one line for each reason why the robot should not start at home; empty if the cell may run.

    Every link with a mass needs a collision shape, unless the cell lists the link as unchecked. The home posture is
    checked against position limits with their margin, torque limits under gravity, and the required distance of every
    monitored pair.

    Args:
        robot: The robot.
        settings: The controller's settings.
        controller: The controller, which needs a certified stop at home. Afterwards the controller is reset to home.
            None if no controller is going to move the arms. Then no certificate is needed, because arms at rest need no
            time to stop.
    """
    lower, upper = robot.position_lower + settings.position_margin, robot.position_upper - settings.position_margin
    change = "to change: control.position_margin, or a fixed joint in the model"
    faults = unchecked_faults(robot)
    faults += _in_degrees(robot)
    faults += [
        f"{name}: position_margin leaves {max(left, 0.0):g} rad of its range; {change}"
        for name, left in zip(robot.joint_names, upper - lower, strict=True)
        if left < _NARROWEST
    ]
    faults += [
        f"home: {name} = {q:g}; allowed: {least:g} .. {most:g} rad, position_margin included"
        for name, q, least, most in zip(robot.joint_names, robot.home, lower, upper, strict=True)
        if not least <= q <= most
    ]
    faults += [
        f"home: {name} needs {needed:.1f} Nm against gravity alone; allowed: its torque limit, {limit:g} Nm; "
        "to change: another home, or the model's torque limits and masses"
        for name, (needed, limit) in joints_that_cannot_hold(robot, robot.home).items()
    ]
    too_close = too_close_at_home(robot, kept_distances(robot, settings), remedies=True)
    faults += too_close
    if controller is not None and not too_close:  # A close pair already explains a missing certificate.
        controller.reset(robot.home)
        report = controller.step({}, controller.settings.max_substep).report
        controller.reset(robot.home)
        if not report.certified:
            tightest = (
                f"{' | '.join(report.tightest_pair)}, {1e3 * report.margin:.1f} mm farther apart than it has to be"
            )
            faults.append(f"home: the controller knows no certified stop from here; tightest pair: {tightest}")
    return tuple(faults)
