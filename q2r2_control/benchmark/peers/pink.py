"""pin-pink: differential inverse kinematics as one QP, on Pinocchio and Coal.

Pink has position, velocity and acceleration limits and a barrier on the nearest pairs. All of them are hard
constraints. If they contradict each other, Pink raises an exception. The barrier does not consider braking distances.
Pink gets the same Pinocchio model, capsules and pairs as our controller, and rows for the ten nearest pairs. With rows
for all pairs, it would take six times as long. By default, its damping towards a safe displacement has the gain 1. Here
this damping is switched off, because it slows down the tools at ticks of 1 ms.
"""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np
import pink
import pinocchio as pin
from pink.barriers import SelfCollisionBarrier
from pink.limits import AccelerationLimit, ConfigurationLimit, VelocityLimit
from pink.tasks import FrameTask, PostureTask

from q2r2_control.benchmark.peers.base import NEAREST_ROWS, PeerSettings
from q2r2_control.types import Array


class Pink:
    """Pink as a controller of the bench; see the module."""

    limitations = "hard limits that can contradict each other; no braking distance to pairs; no certificate"

    def __init__(self, setup: PeerSettings, name: str) -> None:
        self.name = name
        self._collision_model = setup.robot.collision_model
        self._model = setup.robot.model.copy()
        self._model.lowerPositionLimit, self._model.upperPositionLimit = setup.lower, setup.upper
        self._home = setup.robot.home
        self._tasks = {
            arm: FrameTask(description.tool_frame, position_cost=1.0, orientation_cost=1.0, gain=setup.position_gain)
            for arm, description in setup.robot.arms.items()
        }
        self._posture = PostureTask(cost=setup.posture_cost, gain=setup.posture_gain)
        self._posture.set_target(self._home)
        self._acceleration = AccelerationLimit(self._model, setup.acceleration)
        velocity = VelocityLimit(self._model, setup.velocity)
        self._limits = [ConfigurationLimit(self._model), velocity, self._acceleration]
        self._barrier = SelfCollisionBarrier(
            min(NEAREST_ROWS, len(self._collision_model.collisionPairs)),
            gain=setup.config.control.separation_gain,
            d_min=setup.min_distance,
            safe_displacement_gain=0.0,
        )
        self._dt = setup.dt
        self.reset(self._home)

    def reset(self, q: Array) -> None:
        self._configuration = pink.Configuration(
            self._model,
            self._model.createData(),
            q,
            collision_model=self._collision_model,
            collision_data=self._collision_model.createData(),
        )
        self._acceleration.set_last_integration(np.zeros(self._model.nv), self._dt)

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        for arm, task in self._tasks.items():
            task.set_target(targets[arm])
        v = pink.solve_ik(
            self._configuration,
            (*self._tasks.values(), self._posture),
            dt,
            solver="daqp",
            limits=self._limits,
            barriers=[self._barrier],
        )
        self._configuration.integrate_inplace(v, dt)
        self._acceleration.set_last_integration(v, dt)
        return self._configuration.q.copy(), v

    def hold(self) -> tuple[Array, Array]:
        v = np.zeros(self._model.nv)
        self._acceleration.set_last_integration(v, self._dt)
        return self._configuration.q.copy(), v
