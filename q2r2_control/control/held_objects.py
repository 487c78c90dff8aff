"""Which pairs of held objects count, and what they keep.

The kernels have them after all other pairs. One that does not count keeps minus infinity, and is never looked at. What
is picked up touches the table already, or it is drawn larger than it is: no pair may ask for more room than there is.

- a pair that appears keeps  d - S - buffer,  or its own distance where that is less: d is the pair's distance at the
  reference, and the certified stop brings it no closer than d - S (``S``: stop_certificate.py). Hence the stop at hand
  is proven with the object too, whatever the arms do at that moment, and an object never has to be refused;
- what it keeps grows to the same value for the d and S of later, up to the pair's own distance, and never falls. The
  stop at hand keeps it by the same bound, so the invariant holds with the greater distance.

Pairs that go when a gripper lets go can only make room. Two objects that overlap when the second one is gripped are one
that both hands hold: then they are not watched against each other, until one lets go.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.kernel_model import KernelData, KernelModel, stop_buffer
from q2r2_control.control.safety.safety_data import provable_distances
from q2r2_control.errors import RobotError
from q2r2_control.robot.kept_distances import kept_by_objects
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_PERIOD = 0.01  # after which kept distances are looked at again, while they grow [s]


class ObjectPairs:
    """Which objects are held, and what their pairs keep; all arrays are of the objects' pairs alone."""

    def __init__(self, robot: Robot, settings: ControllerSettings, model: KernelModel, data: KernelData) -> None:
        self._robot, self._safety, self._data = robot, model.safety, data.safety
        self._arms, self._holders = tuple(robot.objects.by_arm), robot.objects.holders
        self._shared = np.array([len(holders) > 1 for holders in self._holders], dtype=np.bool_)
        self._range = slice(len(model.safety.min_distance) - len(self._holders), None)
        self._aim(settings)
        self.clear()

    def _aim(self, settings: ControllerSettings) -> None:
        self._goal = kept_by_objects(self._robot, settings).values
        self._buffer = stop_buffer(self._goal, settings)

    def clear(self) -> None:
        """Nothing is held."""
        self.holding: frozenset[str] = frozenset()
        self._new: npt.NDArray[np.bool_] = np.zeros(len(self._holders), dtype=np.bool_)
        self._write(np.full(len(self._holders), -np.inf))

    def set_holding(self, arm: str, holds: bool) -> bool:
        """Take it that an arm's gripper holds its object, or does not; whether that is new.

        Pairs that begin to count keep their own distance until they are measured, and :meth:`begin` then. Raises
        :class:`RobotError` for an arm that has no object.
        """
        if arm not in self._arms:
            allowed = ", ".join(self._arms) or "none"
            raise RobotError(f"holding of arm {arm!r:.40}: its gripper has no object; those that have one: {allowed}")
        if holds == (arm in self.holding):
            return False
        self.holding = self.holding | {arm} if holds else self.holding - {arm}
        counts = np.array([holders <= self.holding for holders in self._holders], dtype=np.bool_)
        self._new = counts & ~np.isfinite(self.kept)
        self._write(np.where(counts, np.where(self._new, self._goal, self.kept), -np.inf))
        return True

    def begin(self) -> None:
        """Let the pairs that have begun to count, and were measured, keep what they can."""
        if not self._new.any():
            return
        kept = np.where(self._new, np.minimum(self._goal, self._within_reach()), self.kept)
        overlap = self._data.distance[self._range] < np.minimum(self._goal, 0.0)
        if (overlap & self._shared & self._new).any():  # both hands hold one object
            kept[self._shared] = -np.inf
        self._write(kept)
        self._due = 0.0

    def grow(self, h: float) -> None:
        """Let what pairs keep grow, ``h`` [s] after the last time, with the reference and the stop as they are now."""
        self._due -= h
        if self._due <= 0.0:
            self._due = _PERIOD
            more = np.maximum(self.kept, np.minimum(self._goal, self._within_reach()))
            self._write(np.where(np.isfinite(self.kept), more, -np.inf))

    def change(self, settings: ControllerSettings) -> None:
        """Let pairs of objects keep what ``settings`` say: less at once, more as :meth:`grow` finds the room."""
        self._aim(settings)
        self._write(np.minimum(self.kept, self._goal))

    def _within_reach(self) -> Array:
        """d - S - buffer [m]."""
        return np.asarray(provable_distances(self._safety, self._data)[self._range] - self._buffer)

    def _write(self, kept: Array) -> None:
        """Tell the kernels what the pairs keep [m]; minus infinity where they do not count."""
        self.kept = kept
        self._safety.min_distance[self._range] = kept
        self._safety.approach.stop_distance[self._range] = kept + self._buffer
        self.growing = bool((np.isfinite(kept) & (kept < self._goal)).any())
