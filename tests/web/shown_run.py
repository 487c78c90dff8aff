"""A stand-in for a run, without robot and loop, for tests of the headset's page.

The test gives the states that the page shows, and sees the requests of the page's buttons.
"""

from __future__ import annotations

from q2r2_control.inputs.webxr.page_messages import HeadsetRequest
from q2r2_control.inputs.webxr.shown import ShownArm, ShownScene, ShownState
from q2r2_control.inputs.webxr.webxr import WebXrInput

RED = (214, 57, 57)


def arm(hand: str, state: str = "lost", why: str = "no pose for 0.15 s") -> ShownArm:
    return {
        "state": state,
        "colour": RED,
        "why": why,
        "next": "press {lower} to engage, press {upper} to close the gripper",
        "hand": hand,
        "silent": state == "lost",
        "tool": (0.5, 0.2, 0.4, 0.0, 0.0, 0.0, 1.0),
        "target": (0.5, 0.3, 0.4, 0.0, 0.0, 0.0, 1.0),
    }


STATE: ShownState = {
    "arms": {hand: arm(hand) for hand in ("left", "right")},
    "joints": [(0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)],
    "parts": {"block": (0.6, 0.0, 0.2, 0.0, 0.0, 0.0, 1.0)},
    "pair": {"ends": ((0.4, 0.1, 0.5), (0.4, -0.1, 0.5)), "margin": 0.03},
    "recording": "records episode 2",
}


class GivenDisplay:
    """A display whose states come from the test and are shown unchanged."""

    def scene(self) -> ShownScene:
        return {
            "name": "two_arms",
            "meshes": [
                {"joint": 0, "colour": (90, 90, 90), "vertices": [0, 0, 0, 1, 0, 0, 0, 1, 0.5], "faces": [0, 1, 2]}
            ],
            "hands": {"left": [0], "right": [0]},
            "parts": {"block": {"size": (0.06, 0.06, 0.06), "colour": (230, 40, 40)}},
            "floor": 0.0,
            "timeout": 0.15,
        }

    def message(self, shown: ShownState) -> ShownState:
        return shown


class ShownRun:
    """Shows states on the page of an input, and keeps the requests of the page's buttons in ``asked``."""

    def __init__(self, source: WebXrInput) -> None:
        self.asked: list[str] = []
        self.source = source
        requests = {request: lambda request=request: self.asked.append(str(request)) for request in HeadsetRequest}
        source.show_on(GivenDisplay(), requests)

    def show(self, state: ShownState = STATE) -> None:
        self.source.show(state)
