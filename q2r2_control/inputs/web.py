"""Hands that a page in a browser moves, without a headset."""

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
    nouns={"drag": "a tool's arrows or rings", "gripper": "the gripper's button"}, verbs={"drag": "drag"}, absent=""
)
_MOTION = ("stance", "axes", "position_scale", "rotation_scale", "axis_scales", "rotation_frame")


def web_cell(config: Config) -> Config:
    """The cell with a page's controls. A page drags the tool itself, which moves as far as its hand."""
    usual = TeleopSettings()
    changes = {name: getattr(usual, name) for name in _MOTION} | {"bindings": _BINDINGS}
    return config.model_copy(update={"teleop": config.teleop.model_copy(update=changes)})


class WebInput:
    """Samples that the page's server sends. Implements :class:`~q2r2_control.inputs.base.Input`.

    Dragging is a dead man. A page that falls silent is found by the teleop layer's gate, as a headset is. A hand is
    stamped with ``clock`` when it is received.
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
        """Nothing to do: the page's server runs already."""

    def receive(
        self, hand: str, position: Sequence[float], quaternion: Sequence[float], controls: Mapping[str, float]
    ) -> None:
        """A hand at ``position`` [m] and ``quaternion`` x y z w, with its ``controls``; from any thread."""
        now = self._clock()
        inputs = HandInputs(more=dict(controls))
        self._driven = True
        self._samples.put(HandSample(hand, np.array(position), np.array(quaternion), now, inputs, now))

    def lose(self) -> None:
        """The page that drove is gone; from any thread."""
        self._samples.cut()
        self._driven = False

    def poll(self, now: float) -> list[HandSample]:
        return self._samples.take()

    def send_haptic(self, feedback: HapticFeedback) -> None:
        """Does nothing: a page has no vibration."""

    def close(self) -> None:
        """Nothing to do: the page ends with the run."""
