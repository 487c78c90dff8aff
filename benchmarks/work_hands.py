"""The hands of an operator who moves the arms through a work motion, as a headset would send them.

Both hands rest and press the lower button to engage, the right hand a little later. Then they move so that exact
samples would give the tool poses of the work motion as targets. The targets of the arms differ from these poses for the
same reasons as in real work: samples are noisy, uneven and late, and they pass through filter, leash and gate.
"""

from __future__ import annotations

from collections.abc import Mapping

import pinocchio as pin

from q2r2_control.benchmark.work_motions import WorkMotion
from q2r2_control.config.teleop import Stance, TeleopSettings
from q2r2_control.inputs.played import EvenSampling, HeadsetSampling, PlayedInput, SampleTiming
from q2r2_control.inputs.scripted import HANDS_AT_REST, PRESS_DURATION
from q2r2_control.teleop.relative import RelativeMotion
from q2r2_control.types import SIDES, HandInputs

# Time when each hand presses. The times differ, because nobody presses with both hands at the same instant [s].
_PRESS_TIMES_S = {"left": 0.2, "right": 0.26}
# Time when the hands begin to move [s]. A press counts only after the wait for a chord, which is a press of two
# buttons. The hands begin half a second after both presses count.
MOTION_BEGINS_S = 1.0
_EVEN_RATE_HZ = 75.0  # Rate of even samples [Hz].
_SENSOR_NOISE = 2e-4  # Standard deviation of the sensor's noise along each axis [m].


class WorkHands(PlayedInput):
    """An :class:`Input` with both hands in one work motion, which begins :data:`MOTION_BEGINS_S` after the first poll.

    ``start`` has the tool poses at which the arms are engaged, in the world frame, by arm. ``settings`` say how hands
    move arms. ``seed`` decides the noise and the uneven times of the samples. If ``seed`` is None, the samples are
    exact and even.
    """

    def __init__(
        self, motion: WorkMotion, start: Mapping[str, pin.SE3], settings: TeleopSettings, seed: int | None = 0
    ) -> None:
        self._motion, self._start = motion, dict(start)
        swapped = settings.stance is not Stance.SIDE_BY_SIDE
        self._arm_of = dict(zip(SIDES, reversed(SIDES) if swapped else SIDES, strict=True))
        self._relative = {hand: _anchored(settings, HANDS_AT_REST[hand], start[self._arm_of[hand]]) for hand in SIDES}
        super().__init__(self._ideal, _buttons, {hand: _sampling(hand, seed) for hand in SIDES})

    def asked(self, t: float) -> dict[str, pin.SE3]:
        """Return the tool poses that the hands ask for at ``t`` [s] since the first poll, in the world frame."""
        return self._motion.targets(min(max(t - MOTION_BEGINS_S, 0.0), self._motion.ends), self._start)

    def _ideal(self, hand: str, t: float) -> pin.SE3:
        return self._relative[hand].hand(self.asked(t)[self._arm_of[hand]])


def _anchored(settings: TeleopSettings, hand: pin.SE3, tool: pin.SE3) -> RelativeMotion:
    motion = RelativeMotion.of(settings)
    motion.anchor(hand, tool)
    return motion


def _sampling(hand: str, seed: int | None) -> SampleTiming:
    return EvenSampling(_EVEN_RATE_HZ) if seed is None else HeadsetSampling(hand, seed, position_noise=_SENSOR_NOISE)


def _buttons(hand: str, t: float) -> HandInputs:
    return HandInputs(button_lower=_PRESS_TIMES_S[hand] <= t < _PRESS_TIMES_S[hand] + PRESS_DURATION)
