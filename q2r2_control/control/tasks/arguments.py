"""Check the arguments of tasks. Each error names the argument and what is allowed."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from q2r2_control.errors import ConfigError, check_kind, shown
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_TINY = 1e-9


def check_robot(robot: Robot) -> None:
    """Raise :class:`ConfigError` unless ``robot`` is a Robot."""
    check_kind("robot", robot, Robot, "a Robot, as Robot.from_config and Robot.from_urdf return")


def chosen_arms(robot: Robot, arms: Sequence[str] | None) -> list[str]:
    """Return the names in ``arms``, or the names of all arms if ``arms`` is None.

    Raises :class:`ConfigError` if a name is not the name of an arm.
    """
    names = list(robot.arms) if arms is None else arms
    if not isinstance(names, list | tuple) or not names or any(name not in [*robot.arms] for name in names):
        raise ConfigError(f"arms = {shown(arms)}: allowed: a list of some of {', '.join(robot.arms)}")
    return list(names)


def positive(key: str, value: float, most: float = math.inf) -> float:
    """Return ``value`` as a float.

    Raises :class:`ConfigError` unless it is a number above 0, and at most ``most``. If ``most`` is finite, ``value``
    is an angle [rad].
    """
    if isinstance(value, bool) or not isinstance(value, float | int) or not (0.0 < value <= most and value < math.inf):
        up_to = "" if most == math.inf else f", at most {most:.2f} rad"
        raise ConfigError(f"{key} = {shown(value, 40)}: allowed: a number above 0{up_to}")
    return float(value)


def vector(key: str, value: Sequence[float]) -> Array:
    """Return ``value`` as an array (3,); raises :class:`ConfigError` unless it is three finite numbers."""
    try:
        numbers = np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        numbers = np.empty(0)
    if numbers.shape != (3,) or not np.isfinite(numbers).all():
        raise ConfigError(f"{key} = {' '.join(str(value).split())[:60]}: allowed: three numbers")
    return numbers


def direction(key: str, value: Sequence[float]) -> Array:
    """Return ``value`` as a unit vector (3,).

    Raises :class:`ConfigError` unless it is three finite numbers, not all 0.
    """
    numbers = vector(key, value)
    if (length := float(np.linalg.norm(numbers))) < _TINY:
        raise ConfigError(f"{key} = {' '.join(str(value).split())[:60]}: allowed: three numbers, not all 0")
    return numbers / length
