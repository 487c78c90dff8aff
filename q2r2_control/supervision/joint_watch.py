"""Whether joint states can be believed: complete, finite, fresh, without jumps, and near what was commanded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from q2r2_control.types import Array, RobotState

# Above what the joints may move between two states: noise, and stamps that a busy machine spreads.
_JUMP_ALLOWANCE, _JUMP_TIME = 0.05, 0.02  # [rad], [s]
# What counts as rest during the time that states have to be good before they are believed [rad].
_REST = 0.01
NONE_YET = "no joint states yet"


@dataclass(slots=True)
class WatchSettings:
    """What joint states have to be; may be changed at run time."""

    timeout: float = 0.1  # [s]
    settle_time: float = 0.1  # that they have to be good and at rest before the arms are activated [s]
    deviation: float = 0.15  # from the reference [rad]
    deviation_time: float = 0.5  # [s]


class JointWatch:
    """Looks at every joint state. Times are receipt times [s]; arrays are (nv,)."""

    def __init__(
        self, names: Sequence[str], velocity_limit: Array, settings: WatchSettings, source: Callable[[], str]
    ) -> None:
        self._names, self._velocity_limit, self._settings = names, velocity_limit, settings
        self._source = source  # where states come from, as " from /node", or ""
        self.state: RobotState | None = None  # the newest that was good
        self.fault: str | None = NONE_YET
        self._still_since, self._still_at = math.inf, np.zeros_like(velocity_limit)
        self._near_at: float | None = None

    def take(self, state: RobotState | str, now: float) -> None:
        """Look at a joint state, or at what is wrong with it."""
        if isinstance(state, str):
            self._fail(state)
            return
        last, self.state = self.state, state
        if last is None or self._still_since == math.inf:
            self._begin(state.q, now)
            return
        moved = np.abs(state.q - last.q)
        reach = self._velocity_limit * (max(now - last.stamp, 0.0) + _JUMP_TIME) + _JUMP_ALLOWANCE
        if (moved > reach).any():
            worst = int((moved - reach).argmax())
            self._fail(f"{self._names[worst]} jumped by {moved[worst]:.3f} rad")
        elif np.abs(state.q - self._still_at).max() > _REST:
            self._begin(state.q, now)

    def settled(self, now: float) -> bool:
        """Whether states have been good and at rest for the settle time."""
        fresh = self.state is not None and now - self.state.stamp <= self._settings.timeout
        return fresh and now - self._still_since >= self._settings.settle_time

    def check(self, now: float) -> str | None:
        """What is wrong now, or None."""
        if self.fault is not None:
            return self.fault
        assert self.state is not None
        if (age := now - self.state.stamp) > self._settings.timeout:
            self._fail(f"no joint states{self._source()} for {age:.3f} s; allowed: {self._settings.timeout:g}")
        return self.fault

    def deviates(self, reference: Array, now: float) -> str | None:
        """Says so where the arms have been too far from ``reference`` for too long."""
        assert self.state is not None
        deviation = np.abs(self.state.q - reference)
        if self._near_at is None or deviation.max() <= self._settings.deviation:
            self._near_at = now
            return None
        if now - self._near_at <= self._settings.deviation_time:
            return None
        worst = int(deviation.argmax())
        return (
            f"{self._names[worst]} is {deviation[worst]:.3f} rad from its reference for {now - self._near_at:.1f} s; "
            f"allowed: {self._settings.deviation:g} rad for {self._settings.deviation_time:g} s"
        )

    def accept(self) -> None:
        """Believe from now on what :meth:`settled` found good."""
        self.fault, self._near_at = None, None

    def _begin(self, q: Array, now: float) -> None:
        self._still_since, self._still_at = now, q

    def _fail(self, fault: str) -> None:
        self._still_since = math.inf
        # The first fault tells most; before the first good state the newest does.
        if self.fault is None or self.state is None:
            self.fault = fault
