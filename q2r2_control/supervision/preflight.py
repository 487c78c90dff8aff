"""What keeps a cell from running, found before anything moves."""

from __future__ import annotations

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.kept_distances import kept_distances, too_close_at_home
from q2r2_control.robot.robot import Robot


def preflight_faults(
    robot: Robot, settings: ControllerSettings, controller: CartesianController | None
) -> tuple[str, ...]:
    """One line for each reason why ``robot`` should not start at home; empty for a cell that may run.

    Looked at are position limits with their margin, every monitored pair against the distance that it keeps, and
    whether the ``controller`` knows a certified stop at home, where it is left reset; None: it moves nothing here.
    """
    lower, upper = robot.position_lower + settings.position_margin, robot.position_upper - settings.position_margin
    faults = [
        f"home: {name} = {q:g}; allowed: {least:g} .. {most:g} rad, position_margin included"
        for name, q, least, most in zip(robot.joint_names, robot.home, lower, upper, strict=True)
        if not least <= q <= most
    ]
    too_close = too_close_at_home(robot, kept_distances(robot, settings))
    faults += too_close
    if controller is not None and not too_close:  # a pair that is too close leaves no certificate, and says more
        controller.reset(robot.home)
        report = controller.step({}, controller.settings.max_substep).report  # every arm holds
        controller.reset(robot.home)
        if not report.certified:
            tightest = (
                f"{' | '.join(report.tightest_pair)}, {1e3 * report.margin:.1f} mm farther apart than it has to be"
            )
            faults.append(f"home: the controller knows no certified stop from here; tightest pair: {tightest}")
    return tuple(faults)
