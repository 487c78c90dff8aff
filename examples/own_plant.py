"""Your own plant, such as a robot behind your own driver. The plant here follows positions with a lag of 5 ms."""

import numpy as np

from q2r2_control import Array, Command, CommandMode, Pipeline, Robot, RobotState, load_config


class LaggingPlant:
    """A plant whose joints follow commanded positions with a time constant of 5 ms."""

    modes: tuple[CommandMode, ...] = (CommandMode.POSITION,)

    def __init__(self, robot: Robot) -> None:
        self.home = robot.home
        self.reset()

    def reset(self, q: Array | None = None) -> None:
        self.q = self.wanted = self.home if q is None else q
        self.v, self.time = np.zeros(len(self.q)), 0.0

    def apply(self, command: Command) -> None:
        """Send the command to the robot."""
        self.wanted = command.q.copy()

    def advance(self, dt: float) -> None:
        """Wait for the next measurement."""
        step = (1.0 - np.exp(-dt / 0.005)) * (self.wanted - self.q)
        self.q, self.v, self.time = self.q + step, step / dt, self.time + dt

    def state(self) -> RobotState:
        return RobotState(self.q.copy(), self.v.copy(), np.zeros(len(self.q)), None, self.time)

    def gripper_openings(self) -> dict[str, float]:
        return {}

    def close(self) -> None: ...


config = load_config("config/dual_iiwa7.yaml")
summary = Pipeline.from_config(config, plant=LaggingPlant(Robot.from_config(config))).run(3.0, realtime=False)
for name, arm in summary.arms.items():
    print(f"{name} arm: tracking error {arm.position_error_mm_rms:.1f} mm RMS")
