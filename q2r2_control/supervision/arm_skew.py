"""Compare the lags with which the arms follow their common reference, and brake all arms if the lags differ too much.

Each arm follows the reference with its own lag [s]. The certificate (control/safety/arm_skew.py) keeps two arms apart
as long as their lags differ by no more than its window. This watch keeps the difference within the window, in every
loop. If one arm falls behind or stops sending, the reference follows its certified stop until the lags differ by no
more than permitted. If this takes more than 0.1 s, the arms stop, and are activated again from rest.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from q2r2_control.events import Reason
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.types import ArmTiming

_TIMING_NOISE_S = 0.001
_MAX_WAIT_S = 0.1


def allowed_skew(timings: Mapping[str, ArmTiming]) -> float:
    """Return the greatest permitted difference between the lags of two arms [s].

    The arms' lags may differ by this much if one message is lost and another message is late.
    """
    return _TIMING_NOISE_S + max((2.0 * timing.period + timing.noise for timing in timings.values()), default=0.0)


def skew_window(timings: Mapping[str, ArmTiming], lead: float) -> float:
    """Return the greatest difference that the arms' lags can reach before all arms brake [s]; 0 for a single arm.

    The value is passed to :meth:`CartesianController.allow_skew`. It is the sum of three times: the permitted
    difference; two periods, for a lost command and for the message that shows the loss; and ``lead``.

    Args:
        timings: The period and the noise of each arm's messages.
        lead: Longest time from the newest posture that was sent to an arm to the end of the newest step of the
            reference [s].
    """
    if len(timings) < 2:
        return 0.0
    return allowed_skew(timings) + 2.0 * max(timing.period for timing in timings.values()) + lead


class SkewWatch:
    """Compares the lags of one loop's arms at every tick."""

    def __init__(self) -> None:
        self.holds = False  # True while all arms brake because one of them is behind or silent.
        self._last_together_s = math.inf

    def observe(self, timings: Mapping[str, ArmTiming], now: float) -> None:
        """Compare the ``timings`` of all arms that follow the reference at time ``now`` [s]."""
        self._allowed, lags = allowed_skew(timings), {arm: timing.lag for arm, timing in timings.items()}
        self._slowest = max(lags, key=lambda arm: lags[arm], default="")
        self._skew = lags[self._slowest] - min(lags.values()) if lags else 0.0
        self.holds = self._skew > self._allowed or self._one_is_silent(timings)
        if not self.holds or self._last_together_s == math.inf:
            self._last_together_s = now

    def _one_is_silent(self, timings: Mapping[str, ArmTiming]) -> bool:
        """Return whether one arm has been silent for longer than another arm, by more than two of its periods.

        If all arms are silent for the same time, this loop was late, and no arm is at fault.
        """
        silent = [timing.silent for timing in timings.values()]
        return any(timing.silent - min(silent) > 2.0 * timing.period + _TIMING_NOISE_S for timing in timings.values())

    def fault(self, now: float) -> Reason | None:
        """Return a reason if, at ``now`` [s], the arms have waited for each other for too long; otherwise None."""
        if not self.holds or now - self._last_together_s <= _MAX_WAIT_S:
            return None
        return Reason.of(
            SupervisionReason.ARMS_APART, arm=self._slowest, skew=1e3 * self._skew, allowed=1e3 * self._allowed
        )
