"""The data of a run's plots: figures of every tick, reduced to a bounded number of rows."""

from __future__ import annotations

import numpy as np

from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick
from q2r2_control.types import Array

_FIRST_INTERVAL = 0.01  # between rows, as long as they fit [s]
_ARM_COLUMNS = 10


class History:
    """Keeps at most ``max_rows`` rows: when they are full, each two become one and the interval doubles.

    Extremes cover every tick, so that no peak is lost between rows; other figures are those at the end of the interval.
    """

    def __init__(self, robot: Robot, acceleration_limit: Array, max_rows: int = 4000) -> None:
        """``acceleration_limit`` (nv,) [rad/s^2] is what accelerations are divided by; ``max_rows`` is even."""
        self.robot = robot
        self._inverse_velocity_limit = 1.0 / robot.velocity_limit
        self._inverse_acceleration_limit = 1.0 / acceleration_limit
        self._nv = len(robot.joint_names)
        self._rows = np.zeros((max_rows, 4 + self._nv + _ARM_COLUMNS * len(robot.arms)))
        self._used = 0
        self._interval = _FIRST_INTERVAL
        self._due = 0.0
        self._margin: float
        self._velocity: float
        self._acceleration: float
        self._forget_extremes()

    def __call__(self, tick: Tick) -> None:
        """Listen to one tick."""
        reference = tick.reference
        self._margin = min(self._margin, reference.report.margin)
        self._velocity = max(self._velocity, float(np.abs(reference.v * self._inverse_velocity_limit).max()))
        self._acceleration = max(
            self._acceleration, float(np.abs(reference.a * self._inverse_acceleration_limit).max())
        )
        if tick.t < self._due:
            return
        self._due = tick.t + self._interval
        if self._used == len(self._rows):
            self._thin_out()
        row = self._rows[self._used]
        row[:4] = tick.t, self._margin, self._velocity, self._acceleration
        row[4 : 4 + self._nv] = tick.state.q
        for index, arm in enumerate(self.robot.arms):
            row[self._columns(index)] = _arm_figures(tick, arm)
        self._used += 1
        self._forget_extremes()

    @property
    def t(self) -> Array:
        """(n,) since the start of the run [s]."""
        return self._rows[: self._used, 0]

    @property
    def margin(self) -> Array:
        """(n,) distance of the tightest pair less the one that it keeps [m]."""
        return self._rows[: self._used, 1]

    @property
    def velocity_ratio(self) -> Array:
        """(n,) of the joint that is nearest to its velocity limit; 1 is the limit."""
        return self._rows[: self._used, 2]

    @property
    def acceleration_ratio(self) -> Array:
        """(n,) of the joint that is nearest to its acceleration limit; 1 is the limit."""
        return self._rows[: self._used, 3]

    @property
    def q(self) -> Array:
        """(n, nv) measured joint positions [rad]."""
        return self._rows[: self._used, 4 : 4 + self._nv]

    def tool(self, arm: str) -> Array:
        """(n, 3) measured tool position in the world [m]."""
        return self._of(arm)[:, 0:3]

    def target(self, arm: str) -> Array:
        """(n, 3) target position in the world [m]; NaN where the arm had none."""
        return self._of(arm)[:, 3:6]

    def position_error(self, arm: str) -> Array:
        """(n,) tool from target [m]; NaN where the arm was not engaged."""
        return self._of(arm)[:, 6]

    def rotation_error(self, arm: str) -> Array:
        """(n,) tool from target [rad]; NaN where the arm was not engaged."""
        return self._of(arm)[:, 7]

    def gripper(self, arm: str) -> Array:
        """(n,) measured opening, 0 closed .. 1 fully open; NaN without a gripper."""
        return self._of(arm)[:, 8]

    def engaged(self, arm: str) -> Array:
        """(n,) 1 where the arm followed its hand, else 0."""
        return self._of(arm)[:, 9]

    def _of(self, arm: str) -> Array:
        return self._rows[: self._used, self._columns(list(self.robot.arms).index(arm))]

    def _columns(self, index: int) -> slice:
        first = 4 + self._nv + _ARM_COLUMNS * index
        return slice(first, first + _ARM_COLUMNS)

    def _forget_extremes(self) -> None:
        self._margin, self._velocity, self._acceleration = np.inf, 0.0, 0.0

    def _thin_out(self) -> None:
        even, odd = self._rows[0::2], self._rows[1::2]
        merged = odd.copy()
        merged[:, 1] = np.minimum(even[:, 1], odd[:, 1])
        merged[:, 2:4] = np.maximum(even[:, 2:4], odd[:, 2:4])
        self._used = len(merged)
        self._rows[: self._used] = merged
        self._interval *= 2.0


def _arm_figures(tick: Tick, arm: str) -> Array:
    figures = np.full(_ARM_COLUMNS, np.nan)
    tool, target = tick.tools[arm], tick.targets[arm].pose
    figures[0:3] = tool.translation
    if target is not None:
        figures[3:6] = target.translation
        if tick.engaged[arm]:
            figures[6:8] = tracking_error(tick, arm)
    figures[8] = tick.grippers.get(arm, np.nan)
    figures[9] = tick.engaged[arm]
    return figures


def tracking_error(tick: Tick, arm: str) -> tuple[float, float]:
    """Distance [m] and angle [rad] of an arm's tool from its target; NaN where it has none."""
    target = tick.targets[arm].pose
    if target is None:
        return np.nan, np.nan
    error = tick.tools[arm].actInv(target)
    sine = np.linalg.norm(error.rotation - error.rotation.T) / np.sqrt(8.0)
    angle = np.arctan2(sine, 0.5 * (np.trace(error.rotation) - 1.0))
    return float(np.linalg.norm(error.translation)), float(angle)
