"""Targets of a tracker, a camera or a policy, which come less often than the controller's steps."""

from __future__ import annotations

import math

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.errors import RobotError, check_kind, shown
from q2r2_control.quaternions import floats_of, se3_of
from q2r2_control.teleop.filters import Interpolator
from q2r2_control.types import is_number

_DELAY_PERIODS = 1.25  # With this delay, a sample may come late by a quarter of a period.
_SLOWEST, _FASTEST = 1.0, 500.0  # Lowest and highest rate of samples [Hz].


class SampledTargets:
    """Tool targets at every step, on straight lines from each sample to the next.

    The controller itself interpolates targets that its caller holds for some steps. It assumes that each target is held
    for the same time as the previous target. This class gets the rate of the samples instead. The motion is therefore
    smoother if samples come unevenly, or less than nine times a second. The targets reach each sample with a delay of
    :attr:`delay` [s]. Steps in between get poses on the line between two samples::

        targets = SampledTargets(controller, rate_hz=90)
        while True:
            for arm, pose in tracker.poll().items():
                targets.set(arm, pose, now)
            reference = controller.step(targets.at(now), dt)

    Nothing is extrapolated: if no more samples come, the tool comes to rest at the newest sample.
    """

    def __init__(self, controller: CartesianController, rate_hz: float) -> None:
        """Make targets for a controller.

        Args:
            controller: The controller, at whose tool poses the targets begin.
            rate_hz: Usual rate of the samples, 1 to 500 [Hz].

        Raises:
            RobotError: If the rate is not allowed, or if ``controller`` is not a controller.
        """
        check_kind("controller", controller, CartesianController, "a CartesianController", RobotError)
        if not is_number(rate_hz) or not _SLOWEST <= rate_hz <= _FASTEST:
            raise RobotError(f"rate_hz = {shown(rate_hz)}: allowed: {_SLOWEST:g} .. {_FASTEST:g}")
        self.delay = _DELAY_PERIODS / rate_hz  # Delay from a sample to its target [s].
        self._controller, self._period = controller, 1.0 / rate_hz
        self._lines: dict[str, Interpolator] = {}

    def set(self, arm: str, pose: pin.SE3, now: float) -> bool:
        """Take a sample.

        The first sample of an arm, and the first sample after :meth:`release`, begin a line at the arm's tool pose.

        Args:
            arm: The arm that the sample is for.
            pose: The tool pose in the world frame.
            now: The time at which the sample arrived, by the same clock as in :meth:`at` [s].

        Returns:
            True if the sample is used. False if the pose is not finite or its matrix is not a rotation; the arm then
            moves on to its last sample.

        Raises:
            RobotError: If the arm does not exist, ``pose`` is not a pinocchio.SE3, or the time is not finite.
        """
        check_kind("pose", pose, pin.SE3, "a pinocchio.SE3", RobotError)
        name, now = self._controller.robot.arm(arm).name, _time(now)
        rotation = pose.rotation
        if not np.isfinite(pose.translation).all() or not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-3):
            return False
        if (line := self._lines.get(name)) is None:
            line = self._lines[name] = Interpolator(self.delay, self._period)
            line.reset(*floats_of(self._controller.tool_pose(name)), now)
        line.add(*floats_of(pose), now, now)
        return True

    def release(self, arm: str) -> None:
        """Let an arm hold. Raises :class:`RobotError` if the arm does not exist."""
        self._lines.pop(self._controller.robot.arm(arm).name, None)

    def at(self, now: float) -> dict[str, pin.SE3]:
        """Return the targets of the arms that have samples, for :meth:`CartesianController.step`.

        Args:
            now: Time of the step, which does not go back [s].

        Raises:
            RobotError: If the time is not finite.
        """
        now = _time(now)
        return {arm: se3_of(line.at(now)[:2]) for arm, line in self._lines.items()}


def _time(now: float) -> float:
    if not is_number(now) or not math.isfinite(now):
        raise RobotError(f"now = {shown(now)}: allowed: a finite time [s]")
    return float(now)
