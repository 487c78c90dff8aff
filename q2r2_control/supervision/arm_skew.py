"""Are all arms at the same place of the one reference? Where one falls behind or is silent, all of them brake.

The certificate (control/safety/arm_skew.py) keeps arms apart that are no farther apart in time than its window. This
watch keeps them within it, and it is the same for every loop. While it holds the arms up, the reference follows its
certified stop. It goes on as soon as the arms are together again. Arms that are held up for a tenth of a second are
activated anew from rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.events import Reason, ReasonKind
from q2r2_control.types import ArmTiming

_SPARE = 0.001  # [s]
_PATIENCE = 0.1  # with arms that are held up [s]


def allowed_skew(timings: Mapping[str, ArmTiming]) -> float:
    """By how much the lags of arms may differ [s]: one message that is lost, and one that is late."""
    return _SPARE + max((2.0 * timing.period + timing.noise for timing in timings.values()), default=0.0)


def skew_window(timings: Mapping[str, ArmTiming], lead: float) -> float:
    """How far arms can be apart in time when all brake [s]; 0 for a single arm. See :meth:`allow_skew`.

    ``lead``: from where the arms are led to the end of the newest step of the reference [s]. To the difference that is
    allowed come an answer that an arm has not heard, and the message that tells of it.
    """
    if len(timings) < 2:
        return 0.0
    return allowed_skew(timings) + 2.0 * max(timing.period for timing in timings.values()) + lead


class SkewWatch:
    """Compares the arms of one loop at every tick."""

    def __init__(self) -> None:
        self.holds = False  # whether all arms brake, until they are together again
        self._together = math.inf  # when they were last [s]

    def observe(self, timings: Mapping[str, ArmTiming], now: float) -> None:
        """Take the ``timings`` of all arms that follow the reference, at ``now`` [s]."""
        self._allowed, lags = allowed_skew(timings), {arm: timing.lag for arm, timing in timings.items()}
        self._last = max(lags, key=lambda arm: lags[arm], default="")
        self._skew = lags[self._last] - min(lags.values()) if lags else 0.0
        self.holds = self._skew > self._allowed or self._one_is_silent(timings)
        if not self.holds or self._together == math.inf:
            self._together = now

    def _one_is_silent(self, timings: Mapping[str, ArmTiming]) -> bool:
        """Whether an arm has said nothing for two periods, while another one was heard. Else this loop was late."""
        silent = [timing.silent for timing in timings.values()]
        return any(timing.silent - min(silent) > 2.0 * timing.period + _SPARE for timing in timings.values())

    def fault(self, now: float) -> Reason | None:
        """A reason where arms have been held up for too long at ``now`` [s], else None."""
        if not self.holds or now - self._together <= _PATIENCE:
            return None
        return Reason.of(ReasonKind.ARMS_APART, arm=self._last, skew=1e3 * self._skew, allowed=1e3 * self._allowed)
