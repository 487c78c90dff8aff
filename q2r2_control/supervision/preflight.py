"""What keeps a cell from running, found before anything moves."""

from __future__ import annotations

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.kept_distances import kept_distances, too_close_at_home
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array


def preflight_faults(
    robot: Robot, settings: ControllerSettings, controller: CartesianController | None
) -> tuple[str, ...]:
    """One line for each reason why ``robot`` should not start at home; empty for a cell that may run.

    Looked at are position limits with their margin, every monitored pair against the distance that it keeps, and
    whether the ``controller`` knows a certified stop at home; without one (None: it moves nothing here) only the first
    two.
    The controller is left reset at home.
    """
    too_close = too_close_at_home(robot, kept_distances(robot, settings))
    faults = [*_outside_limits(robot, robot.home, settings.position_margin), *too_close]
    if controller is not None and not too_close:  # a pair that is too close leaves no certificate, and says more
        faults += _without_certificate(controller)
    return tuple(faults)


def _outside_limits(robot: Robot, home: Array, margin: float) -> list[str]:
    lower, upper = robot.position_lower + margin, robot.position_upper - margin
    return [
        f"home: {name} = {home[index]:g}; allowed: {lower[index]:g} .. {upper[index]:g} rad, position_margin included"
        for index, name in enumerate(robot.joint_names)
        if not lower[index] <= home[index] <= upper[index]
    ]


def _without_certificate(controller: CartesianController) -> list[str]:
    home = controller.robot.home
    controller.reset(home)
    report = controller.step({}, controller.settings.max_substep).report  # every arm holds
    controller.reset(home)
    if report.certified:
        return []
    tightest = f"{' | '.join(report.tightest_pair)}, {1e3 * report.margin:.1f} mm farther apart than it has to be"
    return [f"home: the controller knows no certified stop from here; tightest pair: {tightest}"]
