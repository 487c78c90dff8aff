"""Work with contact forces: two hands carry a tray, a hand wipes the table with a sponge, a peg goes into a hole."""

from __future__ import annotations

import math

from q2r2_control.inputs.way_points import LEFT_HOME, RIGHT_HOME, HandWork, WayPoint

_TURN = 0.5 * math.pi  # With this turn, the fingers close along x [rad].
_X, _Y, _HELD = 0.64, 0.10, 0.235  # Left tool at the tray's handle: x, y, z [m]. The right tool is at -y.
_CARRIED = (_X - 0.115, _HELD + 0.11)  # Positions x and z of both tools at the end of the carry [m].


def _at_handle(side: float) -> tuple[WayPoint, ...]:
    """Return way points over one handle and then down around it. ``side`` is 1 for the left handle, otherwise -1."""
    turn = -side * _TURN
    return (
        (2.2, _X, side * _Y, _HELD + 0.09, 0.0, turn),
        (3.4, _X, side * _Y, _HELD, 0.0, turn),
        (4.8, _X, side * _Y, _HELD, 0.0, turn),  # Grasp. From here, the left hand moves both tools.
    )


def _from_handle(side: float, home: tuple[float, float, float, float, float]) -> tuple[WayPoint, ...]:
    turn = -side * _TURN
    return (
        (15.2, _X, side * _Y, _HELD, 0.0, turn),  # Let go. Each hand moves its own tool again.
        (16.4, _X, side * _Y, _HELD + 0.09, 0.0, turn),
        (18.6, *home),
    )


CARRY = HandWork(
    duration=18.6,
    tools={
        "left": (
            *_at_handle(1.0),
            (6.2, _X, _Y, _CARRIED[1], 0.0, -_TURN),  # Lift.
            (7.8, _CARRIED[0], _Y, _CARRIED[1], 0.0, -_TURN),
            (9.2, _CARRIED[0], _Y, _CARRIED[1], 0.0, -_TURN),
            (10.8, _X, _Y, _CARRIED[1], 0.0, -_TURN),  # Move back.
            (12.6, _X, _Y, _HELD - 0.003, 0.0, -_TURN),  # Put down, until it rests on the table.
            *_from_handle(1.0, LEFT_HOME),
        ),
        "right": (*_at_handle(-1.0), *_from_handle(-1.0, RIGHT_HOME)),
    },
    steps=(
        (0.0, "each hand reaches for a handle of the tray"),
        (3.4, "both grasp"),
        (4.2, "the left hand moves both arms: they lift the tray"),
        (6.2, "they carry it nearer"),
        (9.2, "they put it back"),
        (12.9, "both let go"),
    ),
    presses={"left": (3.5, 13.0), "right": (3.5, 13.0)},
    grips=(4.4, 13.7),
    engages=(14.4,),
)

_SPONGE_X, _SPONGE_Y, _SPONGE_HELD = 0.60, 0.42, 0.248  # Position x, y and z of the tool at the sponge [m].
_WIPING = _SPONGE_HELD - 0.012  # Height of the tool while it wipes, and presses the sponge by 12 mm [m].
# Ends of the strokes: positions x and y of the tool [m].
_STROKES = ((0.72, 0.42), (0.72, 0.39), (0.60, 0.39), (0.60, 0.36), (0.72, 0.36))
WIPE = HandWork(
    duration=19.4,
    tools={
        "left": (
            (1.6, _SPONGE_X, _SPONGE_Y, 0.33, 0.0, 0.0),
            (3.0, _SPONGE_X, _SPONGE_Y, _SPONGE_HELD, 0.0, 0.0),
            (3.8, _SPONGE_X, _SPONGE_Y, _SPONGE_HELD, 0.0, 0.0),  # Grasp.
            (5.0, _SPONGE_X, _SPONGE_Y, _SPONGE_HELD + 0.05, 0.0, 0.0),
            (6.6, _SPONGE_X, _SPONGE_Y, _SPONGE_HELD + 0.01, 0.0, 0.0),
            (8.2, _SPONGE_X, _SPONGE_Y, _WIPING, 0.0, 0.0),  # Press.
            *((10.0 + 1.5 * i, *place, _WIPING, 0.0, 0.0) for i, place in enumerate(_STROKES)),
            (17.4, *_STROKES[-1], _WIPING, 0.0, 0.0),  # Let go where the sponge cannot fall.
            (18.2, *_STROKES[-1], 0.33, 0.0, 0.0),
            (19.4, *LEFT_HOME),
        )
    },
    steps=(
        (0.0, "the left hand reaches for the sponge"),
        (3.0, "it grasps"),
        (6.6, "it presses the sponge on the table"),
        (8.2, "it wipes"),
        (16.6, "it lets go"),
    ),
    presses={"left": (3.1, 16.7)},
)

_PEG, _HOLE = (0.60, -0.40), (0.66, -0.24)  # Positions x and y of the peg and of the hole [m].
_PEG_HELD = 0.265  # Height of the tool at the peg [m]. It is 30 mm above the middle of the peg, which is 70 mm long.
_ON_TOP = _PEG_HELD + 0.04  # Height of the tool when the peg stands on the socket [m].
# The search for the hole: turns of the spiral, its greatest radius [m], and depth of the target below ``_ON_TOP`` [m].
_TURNS, _WIDEST, _PRESSED = 4, 0.004, 0.005


def _searching(begins: float, duration: float) -> tuple[WayPoint, ...]:
    """Return way points on a spiral, along which the peg is pressed lightly on the socket and finds the hole.

    The spiral starts at the time ``begins`` [s], and takes ``duration`` [s].
    """
    points, steps = [], 8 * _TURNS
    for i in range(steps + 1):
        angle, radius = 2.0 * math.pi * _TURNS * i / steps, _WIDEST * i / steps
        x, y = _HOLE[0] + radius * math.cos(angle), _HOLE[1] + radius * math.sin(angle)
        points.append((begins + duration * i / steps, x, y, _ON_TOP - _PRESSED, 0.0, 0.0))
    return tuple(points)


PEG = HandWork(
    duration=24.0,
    tools={
        "right": (
            (1.6, *_PEG, 0.35, 0.0, 0.0),
            (3.0, *_PEG, _PEG_HELD, 0.0, 0.0),
            (3.8, *_PEG, _PEG_HELD, 0.0, 0.0),  # Grasp.
            (5.0, *_PEG, _ON_TOP + 0.03, 0.0, 0.0),
            (6.8, *_HOLE, _ON_TOP + 0.03, 0.0, 0.0),
            (8.2, *_HOLE, _ON_TOP + 0.008, 0.0, 0.0),
            *_searching(9.4, 8.0),
            (19.2, *_HOLE, _ON_TOP - 0.028, 0.0, 0.0),  # Push the peg in.
            (20.6, *_HOLE, _ON_TOP - 0.028, 0.0, 0.0),  # Let go.
            (21.8, *_HOLE, 0.36, 0.0, 0.0),
            (24.0, *RIGHT_HOME),
        )
    },
    steps=(
        (0.0, "the right hand reaches for the peg"),
        (3.0, "it grasps"),
        (5.0, "it carries the peg over the hole"),
        (8.2, "it looks for the hole, with precision"),
        (17.4, "it pushes the peg in"),
        (20.0, "it lets go"),
    ),
    presses={"right": (3.1, 20.0)},
    precise=((8.2, 19.6),),
)
