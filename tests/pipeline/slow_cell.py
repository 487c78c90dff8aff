"""Arms that move slowly behind virtual cabinets, in simulated time."""

from __future__ import annotations

from collections.abc import Callable

import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.pipeline.slow_run import Moment, SlowRun
from q2r2_control.plants.fri.cabinet import StillArm
from q2r2_control.plants.fri.cabinet_server import settings_of
from q2r2_control.plants.fri.wire import CommandKind, Joints, Session
from q2r2_control.robot.robot import Robot
from tests.plants.fri.virtual_cabinets import VirtualCabinets

_LATE = 0.0005  # Largest delay of messages [s].


class WeighedArm(StillArm):
    """An arm that measures the torques of a robot with a load. The client does not know this load."""

    def __init__(self, robot: Robot, arm: str) -> None:
        self._robot, self._joints, self._data = robot, robot.arms[arm].joints, robot.model.createData()
        super().__init__(tuple(robot.home[self._joints]))

    @property
    def tau(self) -> Joints:
        q = self._robot.home.copy()
        q[self._joints] = self.q
        return tuple(pin.computeGeneralizedGravity(self._robot.model, self._data, q)[self._joints])

    @tau.setter
    def tau(self, tau: Joints) -> None:
        """The torque is measured and cannot be set."""


class StuckArm(WeighedArm):
    """An arm with closed brakes."""

    def advance(self, dt: float, q: Joints, tau: Joints | None) -> None:
        """Do not move."""


class PendantCabinets(VirtualCabinets):
    """Virtual cabinets that allow commands (KUKA's overlay) as soon as they are ready, unless they are ``locked``."""

    locked = False

    def due(self, now: float) -> tuple[float, float]:
        for cabinet in self.cabinets.values():
            if cabinet.session is Session.MONITORING_READY and not self.locked:
                cabinet.start_overlay()
        return super().due(now)


def slow_run(
    config: Config,
    arm: type[WeighedArm] = WeighedArm,
    truth: Robot | None = None,
    prepare: Callable[[PendantCabinets], None] = lambda cabinets: None,
    listener: Callable[[Moment], None] | None = None,
) -> SlowRun:
    """Return a slow run of ``config`` behind virtual cabinets.

    The virtual arms have the type ``arm`` and the masses of the robot ``truth``. ``prepare`` gets the cabinets before
    the run. ``listener`` gets the :class:`Moment` of each tick.
    """

    def plant(robot: Robot, slow: Config) -> PendantCabinets:
        settings = {side: settings_of(robot, side, CommandKind.POSITION, 2, 0.01) for side in robot.arms}
        period, longest = 1.0 / slow.nominal_rate_hz, slow.control.max_substep
        made = PendantCabinets(robot, settings, robot.home, period, longest, jitter=_LATE)
        for side, cabinet in made.cabinets.items():
            cabinet.arm = arm(truth or robot, side)
        prepare(made)
        return made

    return SlowRun(config, plant, realtime=False, listener=listener)
