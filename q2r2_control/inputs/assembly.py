"""Small assembly tasks for two hands, as way points. The parts lie on the table of config/dual_iiwa7.yaml.

Nothing is corrected during the work. The positions of the parts are known, and each tool arrives as precisely as the
robot follows the hand.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace

from q2r2_control.inputs.contact_work import CARRY, PEG, WIPE
from q2r2_control.inputs.way_points import LEFT_HOME, RIGHT_HOME, HandWork, WayPoint

# Heights of the tool at a block and over it [m]. The block is 60 mm high, and is held 17 mm above its middle.
_GRIP, _OVER = 0.243, 0.33


def _meeting(middle: float) -> dict[str, tuple[WayPoint, ...]]:
    """Return way points with which both hands bring their blocks to the middle of the cell, and back.

    Where the blocks meet, the tools are ``middle`` [m] to the left and to the right of the cell's centre.
    """
    left: tuple[WayPoint, ...] = (
        (1.4, 0.55, 0.25, 0.35, 0.0, 0.0),  # Over the block.
        (3.2, 0.55, 0.25, _GRIP, 0.0, 0.0),  # Go down around the block.
        (4.2, 0.55, 0.25, _GRIP, 0.0, 0.0),  # Grasp.
        (5.8, 0.55, 0.25, 0.40, 0.0, 0.0),  # Lift.
        (9.0, 0.55, middle, 0.40, -0.25, 0.0),  # Move to the middle, with the wrists outwards.
        (10.0, 0.55, middle, 0.40, -0.25, 0.0),
        (12.8, 0.55, 0.25, 0.40, 0.0, 0.0),  # Move back.
        (14.6, 0.55, 0.25, _GRIP, 0.0, 0.0),  # Put down.
        (15.6, 0.55, 0.25, _GRIP, 0.0, 0.0),  # Let go.
        (17.4, *LEFT_HOME),
    )
    return {"left": left, "right": tuple((t, x, -y, z, -tilt, -turn) for t, x, y, z, tilt, turn in left)}


MEET = HandWork(
    duration=17.4,
    tools=_meeting(0.065),  # At this distance the grippers nearly touch.
    steps=(
        (0.0, "each hand reaches for its block"),
        (3.2, "both grasp"),
        (4.2, "both lift"),
        (5.8, "both meet in the middle"),
        (10.0, "each hand puts its block back"),
        (14.6, "both let go"),
    ),
    presses={"left": (3.5, 14.9), "right": (3.7, 15.1)},
)
# Both hands move to the same position. Since the tools cannot meet there, each target gets 65 mm away from its tool,
# which the leash allows. The hands then bring the blocks back.
CLASH = replace(MEET, tools=_meeting(0.0))

_LOW = 0.216  # Height of the tool at which the finger tips are 3 mm above the table [m].
GRASP = HandWork(
    duration=10.6,
    tools={
        "right": (
            (1.4, 0.45, -0.35, 0.30, 0.0, 0.0),  # Over the block.
            (2.8, 0.45, -0.35, _LOW, 0.0, 0.0),
            (3.5, 0.45, -0.35, _LOW, 0.0, 0.0),  # Grasp.
            (4.9, 0.45, -0.35, _LOW + 0.101, 0.0, 0.0),  # Lift.
            (6.1, 0.45, -0.35, _LOW + 0.101, 0.0, 0.0),
            (7.5, 0.45, -0.35, _LOW, 0.0, 0.0),  # Put down.
            (8.2, 0.45, -0.35, _LOW, 0.0, 0.0),  # Let go.
            (9.2, 0.45, -0.35, 0.30, 0.0, 0.0),
            (10.6, *RIGHT_HOME),
        )
    },
    steps=(
        (0.0, "the right hand reaches for the block"),
        (2.8, "it grasps"),
        (3.5, "it lifts the block"),
        (6.1, "it puts the block back"),
        (7.5, "it lets go"),
    ),
    presses={"right": (2.9, 7.6)},
)

STACK = HandWork(
    duration=14.8,
    tools={
        "left": (
            (0.9, 0.55, 0.25, _OVER, 0.0, 0.0),
            (2.1, 0.55, 0.25, _GRIP, 0.0, 0.0),
            (2.8, 0.55, 0.25, _GRIP, 0.0, 0.0),  # Grasp.
            (3.8, 0.55, 0.25, 0.36, 0.0, 0.0),
            (5.6, 0.52, 0.00, 0.36, 0.0, 0.0),  # Over the block in the middle.
            (6.6, 0.52, 0.00, _GRIP + 0.06, 0.0, 0.0),
            (7.3, 0.52, 0.00, _GRIP + 0.06, 0.0, 0.0),  # Let go.
            (8.3, 0.52, 0.00, 0.40, 0.0, 0.0),
            (9.9, *LEFT_HOME),
        ),
        "right": (
            (4.0, *RIGHT_HOME),
            (5.0, 0.55, -0.25, _OVER, 0.0, 0.0),
            (6.2, 0.55, -0.25, _GRIP, 0.0, 0.0),
            (6.9, 0.55, -0.25, _GRIP, 0.0, 0.0),  # Grasp.
            (8.2, 0.55, -0.25, 0.41, 0.0, 0.0),
            (8.4, 0.55, -0.25, 0.41, 0.0, 0.0),
            (10.2, 0.52, 0.00, 0.41, 0.0, 0.0),  # Over both blocks, while the other hand leaves.
            (11.2, 0.52, 0.00, _GRIP + 0.12, 0.0, 0.0),
            (11.9, 0.52, 0.00, _GRIP + 0.12, 0.0, 0.0),  # Let go.
            (12.8, 0.52, 0.00, 0.42, 0.0, 0.0),
            (14.8, *RIGHT_HOME),
        ),
    },
    steps=(
        (0.0, "the left hand reaches for a block"),
        (2.1, "it grasps"),
        (2.8, "it carries the block to the middle"),
        (5.6, "it puts the block on the first one"),
        (7.3, "the right hand takes another block"),
        (8.4, "it carries the block to the middle"),
        (10.2, "it puts the block on both"),
        (11.9, "both hands go home"),
    ),
    presses={"left": (2.2, 6.7), "right": (6.3, 11.3)},
)

# The bar lies along y. The hands hold it at both ends, and the tools are tilted so that the wrists are farther apart
# than the fingers. If the tools pointed straight down, the wrists would keep them 60 mm too far apart for the bar.
_TILT, _TURN = 0.4, 0.5 * math.pi
_BAR_LOW = 0.2193  # Height of a tilted tool at which its finger tips are 3 mm above the table [m].
_OFF = 0.045  # Distance of each tool from the bar's middle, along the bar [m].
# Distance of a tool from its grasp pose along y and z, before and after the grasp [m].
_BACK_Y, _BACK_Z = 0.09 * math.sin(_TILT), 0.09 * math.cos(_TILT)
_LEFT, _RIGHT = (-_TILT, -_TURN), (_TILT, _TURN)
HANDOVER = HandWork(
    duration=18.4,
    tools={
        "left": (
            (2.2, 0.44, 0.15 + _OFF + _BACK_Y, _BAR_LOW + _BACK_Z, *_LEFT),  # Over the bar's left end.
            (3.4, 0.44, 0.15 + _OFF, _BAR_LOW, *_LEFT),
            (4.1, 0.44, 0.15 + _OFF, _BAR_LOW, *_LEFT),  # Grasp.
            (5.2, 0.44, 0.15 + _OFF, 0.34, *_LEFT),  # Lift.
            (6.8, 0.46, _OFF, 0.38, *_LEFT),  # Move to the middle.
            (9.2, 0.46, _OFF, 0.38, *_LEFT),  # Let go when the other hand holds the bar.
            (10.2, 0.46, _OFF + _BACK_Y, 0.38 + _BACK_Z, *_LEFT),
            (12.4, *LEFT_HOME),
        ),
        "right": (
            (3.4, *RIGHT_HOME),
            (
                5.8,
                0.46,
                -_OFF - _BACK_Y,
                0.38 + _BACK_Z,
                *_RIGHT,
            ),  # Over the future position of the bar's right end.
            (6.8, 0.46, -_OFF - _BACK_Y, 0.38 + _BACK_Z, *_RIGHT),
            (8.0, 0.46, -_OFF, 0.38, *_RIGHT),
            (10.2, 0.46, -_OFF, 0.38, *_RIGHT),  # Grasp, and wait until the other hand has left.
            (11.8, 0.46, -_OFF - 0.12, 0.38, *_RIGHT),  # Carry the bar away.
            (13.0, 0.46, -_OFF - 0.12, 0.38, *_RIGHT),
            (14.6, 0.46, -_OFF - 0.12, _BAR_LOW, *_RIGHT),  # Put down.
            (15.3, 0.46, -_OFF - 0.12, _BAR_LOW, *_RIGHT),  # Let go.
            (16.2, 0.46, -_OFF - 0.12 - _BACK_Y, _BAR_LOW + _BACK_Z, *_RIGHT),
            (18.4, *RIGHT_HOME),
        ),
    },
    steps=(
        (0.0, "the left hand reaches for the bar"),
        (3.4, "it grasps"),
        (4.1, "it lifts the bar to the middle"),
        (6.8, "the right hand takes the bar's other end"),
        (8.7, "the left hand lets go"),
        (10.2, "the right hand carries the bar away"),
        (13.0, "it puts the bar down"),
        (15.3, "both hands go home"),
    ),
    presses={"left": (3.5, 8.7), "right": (8.1, 14.7)},
)


# All works (tasks of both hands), in the order in which they can follow each other.
WORKS: Mapping[str, HandWork] = {
    "meet": MEET,
    "clash": CLASH,
    "grasp": GRASP,
    "carry": CARRY,
    "handover": HANDOVER,
    "stack": STACK,
    "wipe": WIPE,
    "peg": PEG,
}
