"""An input without a headset: the operator drags the tools on a page in a browser."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence

import numpy as np

from q2r2_control.config.bindings import Action, BindingSettings
from q2r2_control.config.cell import Config
from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.device_words import DeviceWords
from q2r2_control.inputs.samples import SampleQueue
from q2r2_control.types import DeviceControls, HandInputs, HandSample, HapticFeedback

_BINDINGS = BindingSettings(
    lower=Action.NONE,
    upper=Action.NONE,
    device={"drag": Action.DEAD_MAN, "gripper": Action.GRIPPER_TOGGLE},
)
_WORDS = DeviceWords(
    nouns={"drag": "a tool's arrows or rings", "gripper": "the gripper's button"},
    verbs={"drag": "drag"},
    absent="",
)
_MOTION = ("stance", "axes", "position_scale", "rotation_scale", "axis_scales", "rotation_frame")


def web_cell(config: Config) -> Config:
    """Return the cell with the page's controls, and with scales of 1, so that a tool moves as far as it is dragged."""
    usual = TeleopSettings()
    changes = {name: getattr(usual, name) for name in _MOTION} | {"bindings": _BINDINGS}
    return config.model_copy(update={"teleop": config.teleop.model_copy(update=changes)})


class WebInput:
    """Gives samples that the page's server sends. Implements :class:`~q2r2_control.inputs.base.Input`.

    A drag acts as a dead man's switch. If a page stops sending, the teleop layer's gate stops the arm, as with a
    headset. ``clock`` gives the time at which each hand is received [s].
    """

    controls = DeviceControls(buttons=("drag", "gripper"), axes=(), words=_WORDS)
    cell = staticmethod(web_cell)

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock, self._samples = clock, SampleQueue()
        self._driven = False

    @classmethod
    def from_config(cls, config: Config) -> WebInput:
        return cls()

    @property
    def connected(self) -> bool:
        return self._driven and not self._samples.is_cut

    def start(self) -> None:
        """Do nothing, since the page's server runs already."""

    def receive(
        self, hand: str, position: Sequence[float], quaternion: Sequence[float], controls: Mapping[str, float]
    ) -> None:
        """Take a hand's ``position`` [m], its ``quaternion`` x y z w, and the values of its ``controls`` by name.

        Any thread may call this.
        """
        now = self._clock()
        inputs = HandInputs(more=dict(controls))
        self._driven = True
        self._samples.put(HandSample(hand, np.array(position), np.array(quaternion), now, inputs, now))

    def lose(self) -> None:
        """Note that the connection to the driving page is lost. Any thread may call this."""
        self._samples.cut()
        self._driven = False

    def poll(self, now: float) -> list[HandSample]:
        return self._samples.take()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Do nothing, since a page has no vibration."""

    def close(self) -> None:
        """Do nothing, since the page ends with the run."""
