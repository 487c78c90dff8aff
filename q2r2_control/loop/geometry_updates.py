"""What of the bodies that are kept apart changes while a run goes on, and that the drive is told of it too."""

from __future__ import annotations

from collections.abc import Mapping

from q2r2_control.control.controller import CartesianController
from q2r2_control.drives.base import Drive
from q2r2_control.supervision.grasp_watch import GraspWatch
from q2r2_control.supervision.gripper_limiter import REMEMBERED, GripperLimiter


class GeometryUpdates:
    """Fingers that move, objects that are held, and distances that other settings ask for.

    Made before the drive is reset, which begins with the weight of what is held; then :meth:`begin`, and in every tick
    :meth:`limit_grippers` before the step and :meth:`after_step`.
    """

    def __init__(
        self,
        controller: CartesianController,
        drive: Drive,
        gripper_delay: float = REMEMBERED,
        grasps: GraspWatch | None = None,
    ) -> None:
        """``gripper_delay``: until a gripper does what it is commanded to, at most [s]; ``grasps``: what is known."""
        self._controller, self._drive = controller, drive
        self._limiter, self._grasps = GripperLimiter(controller, gripper_delay), grasps or GraspWatch(controller)
        self.holding = controller.holding  # of arms whose grippers have an object, whether they hold it
        drive.set_holding(self.holding)

    @property
    def held_grippers(self) -> dict[str, tuple[str, str]]:
        """Arm -> pair of bodies that keeps its gripper from being commanded as wanted."""
        return self._limiter.held

    def resume(self, commanded: Mapping[str, float], measured: Mapping[str, float], now: float) -> None:
        """Begin with grippers that are commanded already; see :meth:`GripperLimiter.resume`. Before :meth:`begin`."""
        self._limiter.resume(commanded, measured, now)

    def begin(self) -> None:
        """The drive was reset."""
        self._kept = self._controller.kept_distances
        self._drive.set_openings(self._controller.openings)
        self._drive.set_kept_distances(self._kept)

    def limit_grippers(
        self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float
    ) -> dict[str, float]:
        """What the grippers are to be commanded to, 0 closed .. 1 fully open; see also whether they hold something.

        Before the step, which has to be proven with fingers that move in it and with objects that are held.
        """
        commanded = self._limiter.limit(wanted, measured, now)
        if self._limiter.changed:
            self._drive.set_openings(self._controller.openings)
        if self._grasps.update(commanded, measured, now):
            self.holding = self._controller.holding
            self._drive.set_holding(self.holding)
        return commanded

    def after_step(self) -> None:
        """The controller's step may have taken up other distances."""
        if self._controller.kept_distances is not self._kept:
            self._kept = self._controller.kept_distances
            self._drive.set_kept_distances(self._kept)
