"""Your own input device, which can be anything that measures two hands. docs/extending.md shows how to install it."""

import numpy as np

from q2r2_control import DeviceControls, HandInputs, HandSample, HapticFeedback, Pipeline, load_config


class SwingingHands:
    """Two hands that press the lower button once, which engages the arms, and then swing."""

    controls = DeviceControls(buttons=("button_lower", "button_upper"), axes=())
    connected = True

    def start(self) -> None:
        self._next = 0.0

    def poll(self, now: float) -> list[HandSample]:
        """Return the samples since the last poll. Each hand has 90 samples per second."""
        if now < self._next:
            return []
        self._next = now + 1.0 / 90.0
        inputs = HandInputs(button_lower=0.2 < now < 0.4)
        position = np.array([0.0, 0.0, 0.05 * np.sin(2.0 * max(now - 0.5, 0.0))])
        upright = np.array([0.0, 0.0, 0.0, 1.0])
        return [HandSample(hand, position, upright, now, inputs, now) for hand in ("left", "right")]

    def send_haptic(self, feedback: HapticFeedback) -> None: ...
    def close(self) -> None: ...


config = load_config("config/dual_iiwa7.yaml")
summary = Pipeline.from_config(config, input=SwingingHands(), plant="kinematic").run(3.0, realtime=False)
for name, arm in summary.arms.items():
    print(f"{name} arm: engaged {arm.engaged_s:.1f} s, tracking error {arm.position_error_mm_rms:.1f} mm RMS")
