"""The data of a run's plots: figures of every tick, reduced to a bounded number of rows."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt

from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array

_FIRST_INTERVAL = 0.01  # between rows, as long as they fit [s]
_ARM = np.dtype(
    [
        ("tool", "f8", 3),  # measured position in the world [m]
        ("target", "f8", 3),  # position in the world [m]; NaN where the arm had none
        ("position_error", "f8"),  # tool from target [m]; NaN where the arm was not engaged
        ("rotation_error", "f8"),  # [rad]
        ("gripper", "f8"),  # measured opening, 0 closed .. 1 fully open; NaN without a gripper
        ("engaged", "f8"),  # 1 where the arm followed its hand, else 0
    ]
)


class History:
    """Keeps at most ``max_rows`` rows: when they are full, each two become one and the interval doubles.

    Extremes cover every tick, so that no peak is lost between rows; other figures are those at the end of the interval.
    """

    def __init__(self, robot: Robot, acceleration_limit: Array, max_rows: int = 4000) -> None:
        """``acceleration_limit`` (nv,) [rad/s^2] is what accelerations are divided by; ``max_rows`` is even."""
        self.robot = robot
        self._acceleration_limit = acceleration_limit
        row: list[Any] = [
            ("t", "f8"),  # since the start of the run [s]
            ("margin", "f8"),  # distance of the tightest pair less the one that it keeps [m]
            ("velocity_ratio", "f8"),  # of the joint that is nearest to its limit; 1 is the limit
            ("acceleration_ratio", "f8"),
            ("q", "f8", len(robot.joint_names)),  # measured [rad]
            *((arm, _ARM) for arm in robot.arms),
        ]
        self._rows = np.zeros(max_rows, dtype=row)
        self._used = 0
        self._interval, self._due = _FIRST_INTERVAL, 0.0
        self._extremes = np.inf, 0.0, 0.0  # since the last row: least margin, greatest ratios

    @property
    def rows(self) -> npt.NDArray[np.void]:
        """All rows by name: ``t``, ``margin``, ``velocity_ratio``, ``acceleration_ratio``, ``q``, and each arm."""
        return self._rows[: self._used]

    def __call__(self, tick: Tick) -> None:
        """Listen to one tick."""
        reference, (margin, velocity, acceleration) = tick.reference, self._extremes
        self._extremes = (
            min(margin, reference.report.margin),
            max(velocity, float((np.abs(reference.v) / self.robot.velocity_limit).max())),
            max(acceleration, float((np.abs(reference.a) / self._acceleration_limit).max())),
        )
        if tick.t < self._due:
            return
        self._due = tick.t + self._interval
        if self._used == len(self._rows):
            self._thin_out()
        arms = (_arm_figures(tick, arm) for arm in self.robot.arms)
        self._rows[self._used] = (tick.t, *self._extremes, tick.state.q, *arms)
        self._used += 1
        self._extremes = np.inf, 0.0, 0.0

    def _thin_out(self) -> None:
        even, odd = self._rows[0::2], self._rows[1::2]
        merged = odd.copy()
        merged["margin"] = np.minimum(even["margin"], odd["margin"])
        for ratio in ("velocity_ratio", "acceleration_ratio"):
            merged[ratio] = np.maximum(even[ratio], odd[ratio])
        self._used = len(merged)
        self._rows[: self._used] = merged
        self._interval *= 2.0


def _arm_figures(tick: Tick, arm: str) -> tuple[Any, ...]:
    pose = tick.targets[arm].pose
    target = np.full(3, np.nan) if pose is None else pose.translation
    errors = tick.tracking_error(arm) if tick.engaged[arm] else (np.nan, np.nan)
    return tick.tools[arm].translation, target, *errors, tick.grippers.get(arm, np.nan), tick.engaged[arm]
