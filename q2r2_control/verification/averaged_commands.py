"""Checks the promises about averaged commands. A cell with a jerk limit commands moving averages of its references.

Each average is the mean of the references in a window of time; see ``robot/command_average.py``.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from q2r2_control.config.control import ControllerSettings
from q2r2_control.drives.command_average import CommandAverage
from q2r2_control.robot.command_average import average_allowance, average_window
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array
from q2r2_control.verification.promises import MeasuredDistances

_PERIOD = 0.001  # Only ticks of exactly this duration, which are called regular, are checked [s].
_EXACT = 1e-12  # A smaller difference between two durations is a rounding error [s].


class AveragedCommands:
    """Averages one reference after another, as a drive does, and measures the resulting commands.

    Jerk and acceleration are differences of commands in ticks of exactly one period. Distances are checked only if the
    bodies did not change in the command's whole window. After a change of fingers or objects, only the new bodies are
    known, but the command is also a mean of references with the earlier bodies.
    """

    def __init__(self, robot: Robot, settings: ControllerSettings, measured: MeasuredDistances) -> None:
        self._average = CommandAverage(average_window(robot, settings), _PERIOD)
        self._measured = measured
        self._acceleration = robot.capped_acceleration(settings.acceleration_limit)
        limit = settings.jerk_limit
        self._jerk = np.broadcast_to(np.inf if limit is None else np.asarray(limit, float), self._acceleration.shape)
        # (p,) The distance of a pair at a command may be smaller than its kept distance by at most this number [m].
        self._allowance = average_allowance(robot, settings, robot.collision_model)
        self._window = 2 * round(self._average.delay / _PERIOD) + 1  # Number of references in a mean.
        self._commands: deque[Array] = deque(maxlen=4)
        self._kept: deque[Array] = deque(maxlen=self._window)  # Kept distances (p,) at the newest regular ticks [m].
        self._regular = 0  # Number of regular ticks since the last irregular tick.

    def start(self, q: Array) -> None:
        """Begin again at ``q`` (nv,) [rad], after a reset."""
        self._average.reset(q)
        self._commands.clear()
        self._kept.clear()
        self._regular = 0

    def bodies_changed(self) -> None:
        """Forget the kept distances, because the opening of a gripper or the object in a gripper has changed."""
        self._kept.clear()

    def update(self, q: Array, v: Array, h: float) -> dict[str, float]:
        """Average a reference ``q`` (nv,) [rad], ``v`` (nv,) [rad/s] that is ``h`` [s] after the previous one.

        Returns:
            The values to check, by the key of their promise; empty until enough ticks in succession were regular.
        """
        if abs(h - _PERIOD) > _EXACT:
            self._regular = 0
            self._kept.clear()
        else:
            self._regular += 1
            self._kept.append(self._measured.kept)
        self._commands.append(self._average.update(q, v, h)[0])
        if self._regular < self._window + 4:
            return {}
        change = np.diff(self._commands, n=2, axis=0) / _PERIOD**2
        return {
            "command_acceleration": float((np.abs(change) / self._acceleration).max()),
            "jerk": float((np.abs(np.diff(change, axis=0)) / _PERIOD / self._jerk).max()),
        }

    def least_margin(self) -> float | None:
        """Return the least distance of a pair at the newest command, minus its kept distance [m].

        None if a body has changed, or if a tick was not regular, within the command's window.
        """
        if len(self._kept) < self._window:
            return None
        kept = np.min(self._kept, axis=0) - self._allowance
        margins = self._measured.margins(self._commands[-1]) + self._measured.kept - kept
        return float(margins.min(initial=np.inf))
