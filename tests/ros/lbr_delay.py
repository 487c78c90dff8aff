"""Delay by the filter of lbr_fri_ros2_stack, and its effect on uneven commands: ``python -m tests.ros.lbr_delay``.

A joint is commanded to move steadily, in virtual time. Once two commands come in one of the driver's periods.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from lbr_fri_idl.msg import LBRJointPositionCommand

from q2r2_control import Robot
from q2r2_control.config.cell import load_config
from tests.ros.fake_lbr import TAU, FakeLbr

_PERIOD = 0.005  # of commands and of the driver [s]
_STEPS = 400
_SPEED = 0.5  # [rad/s]


class FilterFigures(NamedTuple):
    """At one time constant."""

    delay: float  # of the driver's position behind the command [s]
    uneven_speed: float  # after two commands in a period, as a multiple of the commanded one


def measure(robot: Robot, tau: float) -> FilterFigures:
    """``tau``: of the filter, 0 without it [s]."""
    driver = FakeLbr(robot, "left", _PERIOD, tau)
    driver.begin()
    start, delay, fastest = driver.q.copy(), 0.0, 0.0
    for step in range(_STEPS):
        early = step == _STEPS // 2
        commanded = start + _SPEED * _PERIOD * (step + early) * np.eye(7)[6]
        driver.take(LBRJointPositionCommand(joint_position=commanded))
        driver.advance()
        if not early:
            delay = float(commanded[6] - driver.q[6]) / _SPEED
        fastest = max(fastest, float(driver.v[6]))
    assert not driver.trips
    return FilterFigures(delay, fastest / _SPEED)


def main() -> None:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    print(f"commands and driver every {1e3 * _PERIOD:g} ms, and once two commands in a period")
    for tau in (0.0, 0.01, 0.02, TAU):
        figures = measure(robot, tau)
        given = f"joint_position_tau {tau:.2f} s"
        print(
            f"{given}: delay {1e3 * figures.delay:4.1f} ms, then {figures.uneven_speed:.2f} times the commanded speed"
        )


if __name__ == "__main__":
    main()
