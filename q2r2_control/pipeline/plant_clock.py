"""How old the state of a plant is, by the clock of the loop."""

from __future__ import annotations

from q2r2_control.types import RobotState


class PlantClock:
    """A plant stamps its states by a clock of its own, and one that hangs repeats its last state.

    That state is as old as the time that the plant was given since.
    """

    def __init__(self, state: RobotState) -> None:
        """``state``: the first one."""
        self._stamp = state.stamp
        self._unanswered = 0.0  # time that the plant was given since it had a newer state [s]

    def give(self, dt: float) -> None:
        """The plant is let go on by ``dt`` [s]."""
        self._unanswered += dt

    def stamped(self, state: RobotState, now: float) -> tuple[RobotState, float]:
        """The ``state`` that came at ``now`` [s], stamped by the loop's clock, and the plant's time since the last."""
        passed = state.stamp - self._stamp
        if passed != 0.0:
            self._stamp, self._unanswered = state.stamp, 0.0
        # Written out, since dataclasses.replace takes three times as long.
        return RobotState(state.q, state.v, state.tau, state.tau_external, now - self._unanswered), passed
