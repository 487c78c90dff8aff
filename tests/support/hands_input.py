"""An input whose hands follow given paths. A press at 0.1 s engages both arms. Each hand has 75 samples per second."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from q2r2_control.quaternions import rotation_of
from q2r2_control.types import QUEST_CONTROLS, SIDES, Array, HandInputs, HandSample, HapticFeedback

PERIOD = 1.0 / 75.0  # Time between two samples [s].
PRESSED, RELEASED = 0.1, 0.2  # Times at which the lower buttons are pressed and released [s].
ENGAGED = 0.3  # From this time on, both arms follow their hands [s].

# A function of the time [s] that returns the position [m] and the rotation vector [rad] of a hand, together (6,).
Path = Callable[[float], Array]


class HandsInput:
    """Hands that follow paths, which give position and rotation vector. A hand without a path rests."""

    controls = QUEST_CONTROLS

    connected = True

    def __init__(self, **paths: Path) -> None:
        self._paths = paths
        self._next = 0.0

    def start(self) -> None:
        self._next = 0.0

    def poll(self, now: float) -> list[HandSample]:
        if now < self._next - 1e-9:
            return []
        self._next += PERIOD
        inputs = HandInputs(button_lower=PRESSED <= now < RELEASED)
        return [self._sample(hand, inputs, now) for hand in SIDES]

    def _sample(self, hand: str, inputs: HandInputs, now: float) -> HandSample:
        path = self._paths[hand](now) if hand in self._paths else np.zeros(6)
        x, y, z = path[3:].tolist()
        quaternion = np.array(rotation_of((x, y, z)))
        return HandSample(hand, path[:3].copy(), quaternion, now, inputs, now)

    def send_haptic(self, feedback: HapticFeedback) -> None:
        pass

    def close(self) -> None:
        pass
