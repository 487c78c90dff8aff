"""Our controller in the bench: the full tick, certificate and report included."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_SHORTEST_DT = 1e-9  # a tick that moves nothing [s]


class OwnController:
    """:class:`CartesianController` as a :class:`BenchController`.

    It has a cell's settings but the time limit, so that a slow machine computes the same motion.
    """

    limitations = ""

    def __init__(self, robot: Robot, config: Config, name: str = "q2r2_control") -> None:
        self.name = name
        self._controller = CartesianController(robot, config.control.model_copy(update={"solve_time_limit": None}))
        self.stopped: list[bool] = []  # of each tick since the reset: whether the certified stop was executed

    def reset(self, q: Array) -> None:
        """See :class:`BenchController`."""
        self._controller.reset(q)
        self.stopped.clear()

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        reference = self._controller.step(targets, dt)
        self.stopped.append(reference.report.fallback)
        return reference.q, reference.v

    def hold(self) -> tuple[Array, Array]:
        """See :class:`BenchController`; only called after a step that raised, which the contract forbids."""
        reference = self._controller.step({}, _SHORTEST_DT)
        return reference.q, np.zeros_like(reference.v)


def without_pairs(config: Config) -> Robot:
    """The robot of a cell in free air: no pair is monitored, so that the arms go through each other and all else."""
    robot = Robot.from_config(config)
    robot.collision_model.removeAllCollisionPairs()
    return robot
