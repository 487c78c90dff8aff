"""Read the messages of the page. They are JSON, and have the hands' poses and controls for each picture of the headset.

This module uses no sockets.
"""

from __future__ import annotations

from dataclasses import replace
from enum import StrEnum
from typing import Literal

import numpy as np
from pydantic import BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from q2r2_control.config.strict import config_error
from q2r2_control.device_words import QUEST_WORDS
from q2r2_control.errors import ProtocolError
from q2r2_control.inputs.messages import HandMessage, HandPose, MessageType
from q2r2_control.inputs.session import HAND_TOPICS, Reception
from q2r2_control.inputs.webxr.shown import Seven
from q2r2_control.types import QUEST_CONTROLS, DeviceControls, HandFault, HandInputs

LONGEST = 4096  # Greatest length of a message [bytes]. Messages of the page have under 600 bytes.
# The button "pinch" is a pinch of bare fingers, or a touch of a phone's screen. These devices have no other button.
_NOUNS = {**QUEST_WORDS.nouns, "lower": "A, X or Space", "upper": "B, Y or G", "pinch": "the pinch"}
_ABSENT = "nothing: no browser drives, open the page"
CONTROLS = DeviceControls(
    buttons=(*QUEST_CONTROLS.buttons, "pinch"),
    axes=QUEST_CONTROLS.axes,
    words=replace(QUEST_WORDS, nouns=_NOUNS, absent=_ABSENT),
)


class HeadsetRequest(StrEnum):
    """What the buttons of the page request. A page that only watches may request nothing but a stop."""

    STOP = "stop"  # Bring the arms to rest, and end the run.
    HOME = "home"
    PAUSE = "pause"  # Let both arms hold until a new press.


_Hand = Literal["left", "right"]

_NO_POSE = HandPose(np.full(3, np.nan), np.full(4, np.nan), 0.0, "")
_TOPICS = {(topic.hand, topic.kind): name for name, topic in HAND_TOPICS.items()}


class _PageModel(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class HeadsetHand(_PageModel):
    """One hand. Its numbers may have any value, also NaN, since the teleop layer's gate checks them."""

    # Position [m] and quaternion x y z w, in a frame with x forward, y left and z up; None if not known.
    pose: Seven | None
    fault: Literal["hand_untracked", "hand_frame_moved"] | None = None
    buttons: tuple[bool, bool, bool] = (False, False, False)  # Upper, lower, pinch.
    # Stick to the right, stick forward (both -1 to 1); trigger of the index finger, grip of the middle finger (0 to 1).
    axes: tuple[float, float, float, float] = (0.0, 0.0, 0.0, 0.0)


class PageMessage(_PageModel):
    """The message for one picture of the headset. A message without hands only says that the page still runs."""

    seq: int = Field(ge=0, le=1 << 53)
    hands: dict[_Hand, HeadsetHand] = Field(default_factory=dict)
    request: HeadsetRequest | None = None  # The request of a button of the page.
    virtual: bool = False  # True if keys or a gamepad move the hands. Poses of hands at rest then have no noise.

    @property
    def controls(self) -> dict[str, tuple[bool, ...]]:
        """The buttons of each hand: upper, lower, pinch."""
        return {name: hand.buttons for name, hand in self.hands.items()}

    def receptions(self) -> list[Reception]:
        """Return the messages that the Quest2ROS app would send for the same hands."""
        found = []
        for name, hand in self.hands.items():
            upper, lower, pinch = hand.buttons
            inputs = HandInputs(upper, lower, *hand.axes, more={"pinch": float(pinch)})
            fault = None if hand.fault is None else HandFault(hand.fault)
            pose = _NO_POSE
            if hand.pose is None:
                fault = fault or HandFault.UNTRACKED
            else:
                pose = HandPose(np.array(hand.pose[:3]), np.array(hand.pose[3:]), 0.0, "")
            found.append(_reception(name, MessageType.POSE, pose, fault)._replace(virtual=self.virtual))
            found.append(_reception(name, MessageType.INPUTS, inputs))
        return found


def _reception(hand: str, kind: MessageType, message: HandMessage, fault: HandFault | None = None) -> Reception:
    return Reception(_TOPICS[hand, kind], hand, message, fault)


_MESSAGES = TypeAdapter(PageMessage)


def read(message: str | bytes) -> PageMessage:
    """Read a message of the page; raises :class:`ProtocolError` if ``message`` is not such a message."""
    if isinstance(message, bytes):
        raise ProtocolError(f"{len(message)} bytes that are no text; allowed: JSON of the hands")
    try:
        return _MESSAGES.validate_json(message)
    except ValidationError as error:
        raise ProtocolError(f"{message!r:.60} is no message of the page: {config_error(error, PageMessage)}") from None
