"""Your own plant: a robot behind your own driver; here one that follows with a lag of 5 ms.

An installed package names it, so that the commands find it: [project.entry-points."q2r2_control.plants"].
"""

import numpy as np

from q2r2_control import Pipeline, Robot, load_config
from q2r2_control.types import Array, Command, CommandMode, RobotState

LAG = 0.005  # [s]


class LaggingPlant:
    """Follows positions as a first-order system does. Joint arrays are in the order of ``Robot.joint_names``."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION,)

    def __init__(self, robot: Robot) -> None:
        self._home = robot.home
        self.reset()

    def reset(self, q: Array | None = None) -> None:
        """At rest at ``q``, or else at home."""
        self._q = np.array(self._home if q is None else q)
        self._v, self._wanted, self._time = np.zeros_like(self._q), self._q, 0.0

    def apply(self, command: Command) -> None:
        """Send the command to the robot here."""
        self._wanted = command.q.copy()

    def advance(self, dt: float) -> None:
        """Wait for the next measurement here."""
        step = (1.0 - np.exp(-dt / LAG)) * (self._wanted - self._q)
        self._q, self._v, self._time = self._q + step, step / dt, self._time + dt

    def state(self) -> RobotState:
        """The newest measurement."""
        return RobotState(self._q.copy(), self._v.copy(), np.zeros_like(self._q), None, self._time)

    def gripper_openings(self) -> dict[str, float]:
        """It has no grippers."""
        return {}

    def close(self) -> None:
        """Close the connection here."""


config = load_config("config/dual_iiwa7.yaml")
summary = Pipeline.from_config(config, plant=LaggingPlant(Robot.from_config(config))).run(3.0, realtime=False)
print(f"{summary.ticks} ticks, nearest pair {summary.min_distance_mm:.1f} mm")
for name, arm in summary.arms.items():
    print(f"{name} arm: tracking error {arm.position_error_mm_rms:.1f} mm RMS")
