"""A policy drives the arms, and all promises are kept. A trained policy would compute its actions from observations."""

import numpy as np
import pinocchio as pin

from q2r2_control import Array, Observation, Pipeline, PolicyInput, load_config


class Circles:
    """A policy that moves both tools round circles.

    An action has the same numbers as the feature action.tool of a dataset: x y z qx qy qz qw of each arm.
    """

    space = "action.tool"
    rate = 30.0  # Number of actions per second [Hz].

    def __init__(self) -> None:
        self.start: Observation | None = None

    def __call__(self, observation: Observation) -> Array:
        """Return the actions of the next half second. The first action is for the time of the observation."""
        self.start = self.start or observation
        t = observation.time - self.start.time + np.arange(15) / self.rate
        poses = np.array([[pin.SE3ToXYZQUAT(tool) for tool in self.start.tools.values()]] * len(t))
        poses[:, :, 1] += 0.05 * np.sin(2.0 * t)[:, None]
        poses[:, :, 2] += 0.05 * (1.0 - np.cos(2.0 * t))[:, None]
        return poses.reshape(len(t), -1)


if __name__ == "__main__":
    config = load_config("config/dual_iiwa7.yaml")
    summary = Pipeline.from_config(config, input=PolicyInput(Circles()), plant="mujoco").run(4.0, realtime=False)
    for name, arm in summary.arms.items():
        print(f"{name} arm: {arm.policy_s:.1f} s by the policy, tracking error {arm.position_error_mm_rms:.1f} mm RMS")
