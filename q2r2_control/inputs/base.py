"""The interface of every source of hand samples: a script, the headset, a recording."""

from __future__ import annotations

from typing import Protocol, runtime_checkable

from q2r2_control.types import HandSample, HapticFeedback


@runtime_checkable
class Input(Protocol):
    """A source of hand samples, polled once per control tick by the loop's own thread.

    Order of use: ``start``, then ``poll`` and ``send_haptic`` in any order, then ``close``.
    """

    @property
    def connected(self) -> bool:
        """Whether samples can arrive now. The loop reports every change from True to False to the teleop layer."""
        ...

    def start(self) -> None:
        """Begin to receive; returns at once. Raises :class:`Q2R2Error` when the source cannot be opened."""
        ...

    def poll(self, now: float) -> list[HandSample]:
        """Samples that came in since the last poll, oldest first; empty when there are none.

        ``now`` [s] is on the clock of the samples' stamps. Never waits, and never raises because of what was received.
        What it has returned stays as it is: others keep it for some ticks.
        """
        ...

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Vibrate a hand controller if the source has any; otherwise nothing happens. Never waits."""
        ...

    def close(self) -> None:
        """Release every resource; may be called twice."""
        ...
