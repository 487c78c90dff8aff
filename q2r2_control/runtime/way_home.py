"""The way home: from the teleop layer, which knows who asked for it, to supervision, which goes it."""

from __future__ import annotations

from q2r2_control.supervision.supervisor import Supervisor
from q2r2_control.teleop.teleop import Teleop


class WayHome:
    """Begins and ends the way home of one run as its operator asks, and tells the operator how it ended."""

    def __init__(self, teleop: Teleop, supervisor: Supervisor) -> None:
        self._teleop, self._supervisor = teleop, supervisor
        self._begun = False

    def update(self, now: float) -> None:
        """Once a tick, after the operator's hands were looked at and before the step; ``now`` [s] is the loop's."""
        asked, supervisor = self._teleop.homing, self._supervisor
        if asked and not self._begun:
            if refusal := supervisor.go_home():
                self._teleop.end_homing(now, f"not homing: {refusal}", arrived=False)
            else:
                self._begun = True
        elif self._begun and not asked:
            self._begun = False
            supervisor.end_homing()
        elif self._begun and not supervisor.homing:
            self._begun = False
            self._teleop.end_homing(now, supervisor.homing_outcome or "the way home was ended")
