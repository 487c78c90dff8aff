"""Named hostile motions of the targets. Each function returns the targets at the time t [s].

Its second argument has the tool pose of each arm at the start.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping

import numpy as np
import pinocchio as pin

Targets = dict[str, pin.SE3 | None]
Scenario = Callable[[float, Mapping[str, pin.SE3]], Targets]

_RANDOM = np.random.default_rng(7)
_PLACES = [
    {
        side: pin.SE3(pin.exp3(_RANDOM.normal(size=3) * 1.5), _RANDOM.uniform([0.1, -0.8, 0.1], [0.9, 0.8, 1.1]))
        for side in ("left", "right")
    }
    for _ in range(20)
]


def _moved(pose: pin.SE3, by: tuple[float, float, float]) -> pin.SE3:
    return pin.SE3(pose.rotation, pose.translation + np.array(by))


def crossing(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The target of each tool is at the start position of the other tool."""
    return {
        "left": pin.SE3(start["left"].rotation, start["right"].translation),
        "right": pin.SE3(start["right"].rotation, start["left"].translation),
    }


def same_point(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """Both targets are at the same position."""
    middle = 0.5 * (start["left"].translation + start["right"].translation)
    return {side: pin.SE3(pose.rotation, middle) for side, pose in start.items()}


def teleport(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets jump every half second."""
    return dict(_PLACES[int(t / 0.5) % len(_PLACES)])


def unreachable(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets are metres beyond the reach of the arms."""
    return {"left": _moved(start["left"], (3.0, 1.0, 1.0)), "right": _moved(start["right"], (2.0, -3.0, 0.5))}


def overhead(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets are straight up and out of reach, so that both arms stretch out."""
    return {side: _moved(pose, (-0.4, 0.0, 5.0)) for side, pose in start.items()}


def into_the_table(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets are far below the table."""
    return {side: _moved(pose, (0.0, 0.0, -0.6)) for side, pose in start.items()}


def one_arm_frozen(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The left arm has no target, and the target of the right arm is at the start position of the left tool."""
    return {"left": None, "right": pin.SE3(start["right"].rotation, start["left"].translation)}


def not_a_number(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets move up and down. They are invalid in three of four time spans of 50 ms."""
    good = {side: _moved(pose, (0.0, 0.0, 0.1 * np.sin(6.0 * t))) for side, pose in start.items()}
    step = int(t / 0.05) % 4
    if step == 1:
        return {side: pin.SE3(np.eye(3), np.full(3, np.nan)) for side in start}
    if step == 2:
        return {side: pin.SE3(np.eye(3), np.array([np.inf, 0.0, -np.inf])) for side in start}
    if step == 3:
        return {side: pin.SE3(np.zeros((3, 3)), pose.translation) for side, pose in start.items()}
    return dict(good)


def circle(t: float, start: Mapping[str, pin.SE3]) -> Targets:
    """The targets move on slow circles that the tools can follow."""
    phase = 2.0 * np.pi * 0.5 * t
    return {side: _moved(pose, (0.0, 0.1 * np.sin(phase), 0.1 * (1.0 - np.cos(phase)))) for side, pose in start.items()}


SCENARIOS: dict[str, Scenario] = {
    "crossing": crossing,
    "same point": same_point,
    "teleport": teleport,
    "unreachable": unreachable,
    "overhead": overhead,
    "into the table": into_the_table,
    "one arm frozen": one_arm_frozen,
    "not a number": not_a_number,
    "circle": circle,
}
