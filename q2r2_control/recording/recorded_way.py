"""Leads the joints of a cell by the references of a recording, none of which is trusted.

What is sent are joint positions for the controller to hold, so that its promises hold whatever the references are. A
reference that no arm could have got to since the last one that was followed, or that is no number, is not followed at
all: the arms hold until one comes that they can get to. One that is refused by a limit or a distance is followed as far
as that allows. An arm that was held back catches up no faster than on its way home.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import numpy.typing as npt

from q2r2_control.control.tasks.posture import HOLD_GAIN
from q2r2_control.events import ReasonKind
from q2r2_control.recording.recorded_ticks import RecordedTick, RecordedTicks
from q2r2_control.supervision.joint_homing import JointHoming
from q2r2_control.types import LONGEST_DT, Array

_CATCH_UP = 0.3  # [rad/s]
_ROUNDING = 1e-6  # of a velocity limit


class RecordedWay:
    """First to the first reference, from rest, then tick by tick along all. Implements :class:`JointWay`."""

    outcome: ReasonKind | None = None  # a way that others end

    def __init__(
        self, ticks: RecordedTicks, names: tuple[str, ...], limit: Array, way_to: Callable[[Array], JointHoming]
    ) -> None:
        """``names`` and velocity ``limit`` (nv,) [rad/s] of the joints; ``way_to``: see :meth:`Homing.way_to`."""
        self._ticks, self._names, self._limit, self._way_to = ticks, names, limit * (1.0 + _ROUNDING), way_to
        self._approach: JointHoming | None = None
        self._accepted: Array | None = None  # the last reference that was followed
        self._since = 0.0  # recorded time since then [s]
        self.current: RecordedTick | None = None  # whose reference is sent in this tick
        self.refused: str | None = None  # why it is not followed
        self.grippers: dict[str, float] = {}  # wanted openings
        self.fault: str | None = None  # why the first reference was not reached

    @property
    def begun(self) -> bool:
        """Whether the first reference was reached, and the others are sent."""
        return self._accepted is not None

    @property
    def ended(self) -> bool:
        """Whether there is nothing more to send."""
        return self.fault is not None or (self.begun and self._ticks.next is None)

    def advance(self, period: float) -> float:
        """Go on by a tick; returns what it takes [s], ``period`` before the first reference is sent and after the last.

        Raises :class:`RecordingError` for a file that is damaged from here on.
        """
        self.current = None
        if not self.begun or self.ended:
            return period
        tick = self._ticks.advance()
        self.current = tick
        self.grippers |= {arm: opening for arm, opening in tick.grippers.items() if 0.0 <= opening <= 1.0}
        return tick.dt if 0.0 < tick.dt <= LONGEST_DT else period

    def step(self, q: Array, v: Array, dt: float) -> Array | None:
        """See :meth:`JointWay.step`."""
        if self._accepted is None:
            return self._go_to_first(q, v, dt)
        before, ahead = self._accepted, np.zeros_like(q)
        if self.current is not None:
            self._since += dt
            self.refused = self._fault_of(self.current)
            if self.refused is None:
                self._accepted, ahead, self._since = self.current.reference_q, self.current.reference_v, 0.0
        # The controller makes of it the velocity at the end of this tick, at which the recorded one ends there too.
        back = np.clip(HOLD_GAIN * (before - q), -_CATCH_UP, _CATCH_UP)
        wanted: Array = q + (ahead + back) / HOLD_GAIN
        return wanted

    def _go_to_first(self, q: Array, v: Array, dt: float) -> Array | None:
        first = self._ticks.next
        assert first is not None
        if self._approach is None:
            if not np.isfinite(first.reference_q).all():
                self.fault = f"the first reference is not sent: {self._names_of(~np.isfinite(first.reference_q))}"
                self.fault += " is no finite number"
                return None
            self._approach = self._way_to(first.reference_q)
        at = self._approach.step(q, v, dt)
        if self._approach.outcome is ReasonKind.HOMING_ARRIVED:
            self._accepted = first.reference_q
        elif self._approach.outcome is not None:
            no_way = self._approach.outcome is ReasonKind.HOMING_NO_WAY
            self.fault = f"the first reference was not reached: {'no free way was found' if no_way else 'held up'}"
        return at

    def _fault_of(self, tick: RecordedTick) -> str | None:
        """Why a reference cannot be followed at all."""
        assert self._accepted is not None
        bad = ~(np.isfinite(tick.reference_q) & np.isfinite(tick.reference_v))
        if bad.any():
            return f"{self._names_of(bad)} is no finite number"
        away = np.abs(tick.reference_q - self._accepted)
        if (far := away > self._limit * min(self._since, LONGEST_DT)).any():
            return f"{self._names_of(far)} jumps"
        if (fast := np.abs(tick.reference_v) > self._limit).any():
            return f"{self._names_of(fast)} is faster than its limit"
        return None

    def _names_of(self, chosen: npt.NDArray[np.bool_]) -> str:
        found = [name for name, is_it in zip(self._names, chosen, strict=True) if is_it]
        return ", ".join(found[:3]) + (f" and {len(found) - 3} more" if len(found) > 3 else "")
