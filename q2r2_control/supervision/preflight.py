"""What keeps a cell from running, found before anything moves."""

from __future__ import annotations

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.kept_distances import KeptDistances, kept_distances
from q2r2_control.robot.pairs import link_of
from q2r2_control.robot.robot import PairDistance, Robot
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
    too_close = _closer_than_allowed(robot, robot.home, kept_distances(robot, settings))
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


def _closer_than_allowed(robot: Robot, home: Array, kept: KeptDistances) -> list[str]:
    pairs = zip(robot.distances(home), kept.values.tolist(), kept.keys, strict=True)
    return [
        f"home: {pair.name_a} and {pair.name_b} are {1e3 * pair.distance:.1f} mm apart; "
        f"allowed: at least {key}, {1e3 * least:.1f} mm{_way_out(pair)}"
        for pair, least, key in sorted(pairs, key=lambda found: found[0].distance)
        if pair.distance < least
    ]


def _way_out(pair: PairDistance) -> str:
    """What the cell's YAML says about a floor that is not where it was meant to be, or was not meant at all."""
    with_floor = FLOOR in (link_of(pair.name_a), link_of(pair.name_b))
    return "; the key floor takes another height, or null for no floor" if with_floor else ""


def _without_certificate(controller: CartesianController) -> list[str]:
    home = controller.robot.home
    controller.reset(home)
    report = controller.step({}, controller.settings.max_substep).report  # every arm holds
    controller.reset(home)
    if report.certified:
        return []
    tightest = f"{' | '.join(report.tightest_pair)}, {1e3 * report.margin:.1f} mm farther apart than it has to be"
    return [f"home: the controller knows no certified stop from here; tightest pair: {tightest}"]
