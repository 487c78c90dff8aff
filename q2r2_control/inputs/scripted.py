"""Scripted hands: ideal or human-like motion with button presses, the same at every run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pinocchio as pin

from q2r2_control.config.cell import Config
from q2r2_control.errors import ConfigError
from q2r2_control.inputs.played import EvenSampling, HeadsetSampling, PlayedInput, SampleTiming
from q2r2_control.inputs.trajectories import trajectory_named
from q2r2_control.types import SIDES

# Where an operator holds the hands; only what follows from here on moves an arm.
HANDS_AT_REST = {
    "left": pin.SE3(pin.rpy.rpyToMatrix(0.1, -0.2, 0.3), np.array([0.35, 0.25, 1.1])),
    "right": pin.SE3(pin.rpy.rpyToMatrix(-0.1, -0.2, -0.3), np.array([0.35, -0.25, 1.1])),
}
_DROPOUT_PROBABILITY = 0.005
# Half a central difference of the ideal pose [s].
_DIFFERENCE = 1e-4


DEFAULT_TRAJECTORY = "meet"


class ScriptedInput(PlayedInput):
    """Plays a trajectory of both hands, from the first poll on. Implements :class:`Input`.

    ``human`` hands are those of :class:`HeadsetSampling`, with tremor and dropouts. Others are sampled at an even rate,
    and received each later by up to ``jitter`` [s]. Circle, line and rotate repeat ``frequency_hz`` times a second.
    Raises :class:`ConfigError` for an unknown trajectory or hand, and for a number that is not allowed.
    """

    def __init__(
        self,
        trajectory: str,
        hands: Sequence[str] = SIDES,
        human: bool = False,
        seed: int = 0,
        rate_hz: float = 75.0,
        frequency_hz: float = 0.25,
        jitter: float = 0.0,
    ) -> None:
        for hand in hands:
            if hand not in SIDES:
                raise ConfigError(f"scripted hand {hand!r}: allowed are {', '.join(SIDES)}")
        for name, value, limit in (("rate_hz", rate_hz, 2000.0), ("frequency_hz", frequency_hz, 2.0)):
            if not 0.0 < value <= limit:
                raise ConfigError(f"scripted input: {name} = {value!r}: allowed is above 0 and up to {limit:g}")
        if not 0.0 <= jitter <= 0.5 / rate_hz:
            raise ConfigError(
                f"scripted input: jitter = {jitter!r}: allowed is 0 .. {0.5 / rate_hz:.3g}, half a sample"
            )
        self._trajectory = trajectory_named(trajectory)
        self._frequency = frequency_hz

        def sampling(hand: str) -> SampleTiming:
            if not human:
                return EvenSampling(rate_hz, jitter, (seed, SIDES.index(hand)))
            return HeadsetSampling(hand, seed, tremor=True, dropout_probability=_DROPOUT_PROBABILITY)

        super().__init__(self._ideal, self._trajectory.inputs, {hand: sampling(hand) for hand in hands})

    @classmethod
    def from_config(cls, config: Config) -> ScriptedInput:
        """The default trajectory."""
        return cls(DEFAULT_TRAJECTORY)

    def hand_twist(self, hand: str, t: float) -> pin.Motion:
        """How ``hand`` ideally moves at ``t`` [s], in the axes that its poses have [m/s, rad/s]."""
        t -= self._origin or 0.0  # before the difference, which on a clock that counts since 1970 would be coarse
        before, after = self._ideal(hand, t - _DIFFERENCE), self._ideal(hand, t + _DIFFERENCE)
        linear = (after.translation - before.translation) / (2.0 * _DIFFERENCE)
        return pin.Motion(linear, pin.log3(after.rotation @ before.rotation.T) / (2.0 * _DIFFERENCE))

    def _ideal(self, hand: str, t: float) -> pin.SE3:
        displacement, turn = self._trajectory.displacement(hand, t, self._frequency)
        home = HANDS_AT_REST[hand]
        return pin.SE3(pin.exp3(turn) @ home.rotation, home.translation + displacement)
