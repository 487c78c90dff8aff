"""A scripted operator: where both hands are and which buttons they press at a time, without sockets or clocks."""

from __future__ import annotations

import math
from dataclasses import dataclass

from q2r2_control.inputs.assembly import minimum_jerk
from q2r2_control.quaternions import Quaternion, Vector, rotation_of, turned_by

HANDS = ("left", "right")

HOLD = 0.12  # a button press [s]
SECOND_HAND_LATER = 0.06  # no operator presses both hands at once [s]
RADIUS = 0.1  # of the circles [m]
SWAY = 0.2  # largest rotation while circling [rad]
TURN = math.radians(120.0)
START: dict[str, Vector] = {"left": (0.3, 0.2, 1.1), "right": (0.3, -0.2, 1.1)}


@dataclass(frozen=True)
class Reading:
    """The data that one hand sends at one time."""

    hand: str
    position: Vector
    quaternion: Quaternion
    upper: bool
    lower: bool


@dataclass(frozen=True)
class Script:
    """Times [s] of an operator's session; hands rest outside ``circles`` and ``turn``."""

    lower: tuple[float, ...]
    upper: tuple[float, ...]
    circles: tuple[tuple[float, float], ...]  # start and end, one turn each
    turn: tuple[float, float] | None  # the left hand turns by TURN, and stays turned

    def reading(self, hand: str, t: float) -> Reading:
        phase = sum(2.0 * math.pi * _smooth(t, *circle) for circle in self.circles)
        y, z = RADIUS * math.sin(phase), RADIUS * (1.0 - math.cos(phase))
        x0, y0, z0 = START[hand]
        turned = TURN * _smooth(t, *self.turn) if hand == "left" and self.turn is not None else 0.0
        qx, qy, qz, qw = turned_by(rotation_of((turned, 0.0, 0.0)), (0.0, 0.0, SWAY * math.sin(phase)))
        delay = 0.0 if hand == "left" else SECOND_HAND_LATER
        return Reading(
            hand=hand,
            position=(x0, y0 + y, z0 + z),
            quaternion=(-qx, -qy, -qz, -qw),  # the connector's conversion sends an identity with w = -1
            upper=any(0.0 <= t - delay - press < HOLD for press in self.upper),
            lower=any(0.0 <= t - delay - press < HOLD for press in self.lower),
        )


def acceptance_script(duration: float) -> Script:
    """Engage, circle, pause, turn the left hand by 120 degrees, resume, circle, close the grippers, circle on."""
    unit = duration / 20.0
    return Script(
        lower=(0.5 * unit, 6.5 * unit, 9.5 * unit),
        upper=(14.5 * unit,),
        circles=((1.0 * unit, 6.0 * unit), (10.0 * unit, 14.0 * unit), (15.0 * unit, 19.5 * unit)),
        turn=(7.0 * unit, 9.0 * unit),
    )


def circle_script(duration: float) -> Script:
    """Engage, then circle without rest until the end."""
    period = 5.0
    starts = [1.0 + period * index for index in range(1 + int(duration / period))]
    return Script(lower=(0.5,), upper=(), circles=tuple((start, start + period) for start in starts), turn=None)


SCRIPTS = {"acceptance": acceptance_script, "circle": circle_script}


def _smooth(t: float, start: float, end: float) -> float:
    return minimum_jerk((t - start) / (end - start))
