"""A hand's pose that stays the same to the last bit while messages go on: no sensor's, but a copy of an old one."""

from __future__ import annotations

from q2r2_control.inputs.messages import HandPose


class FrozenPose:
    """Watches the poses of one hand. A hand at rest is not frozen: sensor noise changes its numbers in every sample."""

    def __init__(self, allowed: float | None) -> None:
        """``allowed``: a pose may stay the same for this long [s]; None: for ever."""
        self._allowed = allowed
        self._numbers = b""
        self._since = 0.0

    def receive(self, pose: HandPose, now: float) -> bool:
        """Whether ``pose``, received at ``now`` [s], has been the same for too long. Stamp and frame do not count."""
        numbers = pose.position.tobytes() + pose.quaternion.tobytes()
        if numbers != self._numbers:
            self._numbers, self._since = numbers, now
        return self._allowed is not None and now - self._since >= self._allowed
