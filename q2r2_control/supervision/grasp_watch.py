"""Whether grippers hold something: they are to close farther, and do not.

A gripper that holds is open by more than it is asked to be and stays so. Where no opening is measured nothing can be
seen, and one that is to be closed counts as holding: an object that is not there costs room, one that is not counted
could hit something.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.control.controller import CartesianController

# How much farther open than asked each finger is that holds something, and that does not any more [m or rad].
_SQUEEZES, _SLIPPED = 0.002, 0.001
# A finger that moves by less than this in that time is held up [m or rad], [s]. A gripper may take a while to begin.
_STILL, STALL = 0.0005, 0.2
_CLOSED = 0.5  # a gripper that is not measured is taken as closed below this opening


class GraspWatch:
    """Tells the controller which grippers hold their objects, of those that have one in the cell's YAML."""

    def __init__(self, controller: CartesianController, stall: float = STALL) -> None:
        """``stall``: after which a gripper that was told to close and stands still is held up [s]."""
        self._controller = controller
        arms = controller.robot.arms
        self._grips = {arm: Grip(arms[arm].stroke, stall) for arm in controller.robot.objects.by_arm}

    def tell_again(self) -> None:
        """The controller was reset: tell it at once of what grippers held before."""
        for arm, grip in self._grips.items():
            if grip.holds:
                self._controller.set_holding(arm, True)

    def update(self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float) -> bool:
        """Look at wanted and measured openings at ``now`` [s], before the controller's step; whether something changed.

        Openings are 0 closed .. 1 fully open. While a measurement fails, what was known stays.
        """
        changed = False
        for arm, grip in self._grips.items():
            if arm in wanted:
                holds = grip.look(wanted[arm], measured.get(arm), now)
                if holds != self._controller.holding[arm]:
                    self._controller.set_holding(arm, holds)
                    changed = True
        return changed


class Grip:
    """What was seen of one gripper."""

    def __init__(self, stroke: float, stall: float = STALL) -> None:
        self._stroke, self._stall = stroke, stall
        self.holds = False
        self._seen, self._since = math.nan, -math.inf  # opening, and since when it has been about that [s]

    def look(self, wanted: float, measured: float | None, now: float) -> bool:
        if measured is None and math.isnan(self._seen):
            self.holds = wanted < _CLOSED
        elif measured is not None and math.isfinite(measured):
            self._judge((measured - wanted) * self._stroke, measured * self._stroke, now)
        return self.holds

    def _judge(self, squeezed: float, opening: float, now: float) -> None:
        if squeezed <= _SLIPPED:
            self.holds = False
        if squeezed <= _SQUEEZES or not abs(opening - self._seen) <= _STILL:
            self._seen, self._since = opening, now
        elif now - self._since >= self._stall:
            self.holds = True
