"""Ideal hand motions with their button presses, to test the robot's response without an operator.

All are written for the left hand, as displacements from wherever the hand starts; the right hand mirrors them left to
right. Axes: x forwards, y to the left, z up. Only the handover goes below
the start, to what lies on the table of config/dual_iiwa7.yaml.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field

import numpy as np

from q2r2_control.types import Array, HandInputs

PRESS_DURATION = 0.15  # [s]
_FIRST_PRESS = 0.6  # when the lower buttons engage both arms [s]
_START = 1.2  # of the motion [s]
_RAMP = 1.0  # periodic motions gather speed for this long [s]


@dataclass(frozen=True)
class Trajectory:
    """What both hands do over time."""

    # (t [s], frequency [Hz]) -> displacement (3,) [m] and rotation vector (3,) [rad] of the left hand
    displacement: Callable[[float, float], tuple[Array, Array]]
    upper_presses: Mapping[str, tuple[float, ...]] = field(default_factory=dict)  # hand -> times [s]
    lower_presses: tuple[float, ...] = (_FIRST_PRESS,)  # of both hands [s]

    def inputs(self, hand: str, t: float) -> HandInputs:
        """Buttons of ``hand`` at time ``t`` [s]; a closed hand also shows on the index trigger."""
        upper = self.upper_presses.get(hand, ())
        return HandInputs(
            button_upper=_pressed(upper, t),
            button_lower=_pressed(self.lower_presses, t),
            press_index=float(sum(press <= t for press in upper) % 2),
        )


def mirrored(displacement: Array, turn: Array) -> tuple[Array, Array]:
    """The same motion of the other hand: reflected in the plane between left and right."""
    return displacement * (1.0, -1.0, 1.0), turn * (-1.0, 1.0, -1.0)


def _pressed(presses: tuple[float, ...], t: float) -> bool:
    return any(press <= t < press + PRESS_DURATION for press in presses)


def _phase(t: float, frequency: float) -> float:
    """Angle of a periodic motion that gathers speed without a jerk [rad]."""
    elapsed = max(t - _START, 0.0)
    if elapsed < _RAMP:
        return math.pi * frequency * (elapsed - _RAMP / math.pi * math.sin(math.pi * elapsed / _RAMP))
    return 2.0 * math.pi * frequency * (elapsed - _RAMP / 2.0)


def _circle(t: float, frequency: float) -> tuple[Array, Array]:
    """Radius 0.1 m, sidewards and up, as Quest2ROS2's SimulationInput draws it."""
    phase = _phase(t, frequency)
    return np.array([0.0, 0.1 * math.sin(phase), 0.1 * (1.0 - math.cos(phase))]), np.zeros(3)


def _line(t: float, frequency: float) -> tuple[Array, Array]:
    """0.15 m there and back, forwards and up."""
    way = 0.15 * (1.0 - math.cos(_phase(t, frequency))) / 2.0
    return way * np.array([0.6, 0.0, 0.8]), np.zeros(3)


def _rotate(t: float, frequency: float) -> tuple[Array, Array]:
    """30 degrees there and back about x, y and z in turn, 0.05 m above the start."""
    phase = _phase(t, frequency)
    turn = np.zeros(3)
    turn[int(phase / (2.0 * math.pi)) % 3] = math.radians(30.0) * (1.0 - math.cos(phase)) / 2.0
    lift = 0.05 * minimum_jerk((t - _START) / _RAMP)
    return np.array([0.0, 0.0, lift]), turn


# t [s], displacement [m], tilt about x [rad]: wrists outwards, so that the finger tips are what comes nearest.
_HANDOVER = np.array(
    [
        (1.2, 0.00, 0.00, 0.000, 0.00),
        (2.6, 0.05, 0.00, -0.030, 0.00),  # over the block
        (4.4, 0.05, 0.00, -0.137, 0.00),  # down around it
        (5.4, 0.05, 0.00, -0.137, 0.00),  # grasp
        (7.0, 0.05, 0.00, 0.020, 0.00),  # lift
        (10.2, 0.05, -0.185, 0.020, -0.25),  # to the middle, where the two grippers nearly touch
        (11.2, 0.05, -0.185, 0.020, -0.25),
        (14.0, 0.05, 0.00, 0.020, 0.00),  # back
        (15.8, 0.05, 0.00, -0.137, 0.00),  # put down
        (16.8, 0.05, 0.00, -0.137, 0.00),  # let go
        (18.6, 0.00, 0.00, 0.000, 0.00),  # away
    ]
)


def _reach_grasp_handover(t: float, frequency: float) -> tuple[Array, Array]:
    """Each hand picks a block up, both meet in the middle, each puts its block back; ``frequency`` means nothing.

    Between rests by minimum-jerk motions (Flash and Hogan, 1985), as people reach.
    """
    times = _HANDOVER[:, 0]
    index = int(np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2))
    fraction = minimum_jerk((t - times[index]) / (times[index + 1] - times[index]))
    where = (1.0 - fraction) * _HANDOVER[index, 1:] + fraction * _HANDOVER[index + 1, 1:]
    return where[:3], np.array([where[3], 0.0, 0.0])


def minimum_jerk(fraction: float) -> float:
    """Share of the way at a ``fraction`` of the time: 0 to 1, at rest at both ends; fractions beyond them are cut."""
    s = min(max(fraction, 0.0), 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


TRAJECTORIES: Mapping[str, Trajectory] = {
    "circle": Trajectory(_circle),
    "line": Trajectory(_line),
    "rotate": Trajectory(_rotate),
    "reach_grasp_handover": Trajectory(
        _reach_grasp_handover,
        upper_presses={"left": (4.7, 16.1), "right": (4.9, 16.3)},
        lower_presses=(_FIRST_PRESS, 19.0),
    ),
}
