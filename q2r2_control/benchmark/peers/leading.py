"""Targets ahead of time for peers, which know where a target is and not how fast it moves.

A tool that follows with a gain stays behind by the target's speed over that gain: 38 mm at 0.3 m/s and 8 /s, which
would hide all else. With its target that much ahead it follows without a lag, as ours does with feed-forward.
"""

from __future__ import annotations

from collections.abc import Mapping

import pinocchio as pin

from q2r2_control.benchmark.peers.base import BenchController
from q2r2_control.types import Array


class Leading:
    """A peer that is given its targets ahead along their way."""

    def __init__(self, peer: BenchController, gain: float) -> None:
        """``gain`` of the peer's tools [1/s]."""
        self.name, self.limitations = peer.name, peer.limitations
        self._peer, self._gain = peer, gain
        self._last: Mapping[str, pin.SE3] = {}

    def reset(self, q: Array) -> None:
        """See :class:`BenchController`."""
        self._last = {}
        self._peer.reset(q)

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        last, self._last = self._last or targets, targets
        return self._peer.step({arm: self._ahead(last[arm], pose, dt) for arm, pose in targets.items()}, dt)

    def hold(self) -> tuple[Array, Array]:
        """See :class:`BenchController`."""
        return self._peer.hold()

    def _ahead(self, last: pin.SE3, pose: pin.SE3, dt: float) -> pin.SE3:
        """Where ``pose`` would be after 1 / gain, going on as since the ``last`` tick, in a straight line."""
        share = 1.0 / (self._gain * dt)
        turn = pin.exp3(share * pin.log3(pose.rotation @ last.rotation.T))
        return pin.SE3(turn @ pose.rotation, pose.translation + share * (pose.translation - last.translation))
