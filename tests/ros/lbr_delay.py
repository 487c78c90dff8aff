"""What the filter of lbr_fri_ros2_stack costs, and what it is good for: ``python -m tests.ros.lbr_delay``.

A joint is commanded to move steadily, in virtual time. One command in the middle is late, and those behind it wait.
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
_LATE = 0.01  # [s]


class FilterFigures(NamedTuple):
    """At one time constant."""

    tau: float  # [s]
    delay: float  # of the driver's position behind the command [s]
    late_speed: float  # after a command that was late, as a multiple of the commanded one


def measure(robot: Robot, tau: float, late: float = _LATE) -> FilterFigures:
    """``tau``: of the filter, 0 without it; ``late``: by how much one command is [s]."""
    driver = FakeLbr(robot, "left", _PERIOD, tau)
    driver.begin()
    start, delay, fastest = driver.q.copy(), 0.0, 0.0
    for step in range(_STEPS):
        waits = 0 <= step - _STEPS // 2 < round(late / _PERIOD)
        commanded = start + _SPEED * _PERIOD * step * np.eye(7)[6]
        if not waits:
            driver.take(LBRJointPositionCommand(joint_position=commanded))
        driver.advance()
        fastest = max(fastest, float(driver.v[6]))
        if step == _STEPS // 2 - 1:
            delay = float(commanded[6] - driver.q[6]) / _SPEED
    assert not driver.trips
    return FilterFigures(tau, delay, fastest / _SPEED)


def main() -> None:
    robot = Robot.from_config(load_config("config/dual_iiwa7.yaml"))
    print(f"commands and driver every {1e3 * _PERIOD:g} ms, one command {1e3 * _LATE:g} ms late")
    for tau in (0.0, 0.01, 0.02, TAU):
        figures = measure(robot, tau)
        given = f"joint_position_tau {tau:.2f} s"
        print(f"{given}: delay {1e3 * figures.delay:4.1f} ms, {figures.late_speed:.2f} times the speed after it")


if __name__ == "__main__":
    main()
