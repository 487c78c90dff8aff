"""The record of one tick, which the listeners of a run get."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import pinocchio as pin

from q2r2_control.compliance.admittance import AdmittanceReport
from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport
from q2r2_control.config.moving_obstacle import ObstacleReport
from q2r2_control.events import Event
from q2r2_control.teleop.arm_states import ArmState
from q2r2_control.types import ActionChunk, ArmTarget, Command, HandSample, Reference, RobotState


@dataclass(frozen=True, slots=True)
class RunStart:
    """The time and the measured state at the beginning of a run."""

    now: float  # Time of the loop's clock [s].
    state: RobotState


@dataclass(slots=True)
class Tick:
    """All data of one tick, for the listeners. The listeners must not change these data."""

    t: float  # Time since the start of the run [s].
    start: RunStart
    now: float  # Time of the loop's clock, which also stamps the samples [s].
    dt: float  # Time since the last tick [s].
    step: float  # Time by which the reference moved; less than dt if the motion is stretched after a late tick [s].
    following: bool  # False while the run ends. Input and targets then do not count any more.
    connected: bool  # Whether the input was connected.
    samples: list[HandSample]  # The new samples of the hands.
    targets: dict[str, ArmTarget]  # The operator's targets, without the displacement of an admittance.
    engaged: dict[str, bool]  # For each arm, whether it follows a hand or a policy.
    states: dict[str, str]  # The teleop layer's state of each arm, or STOPPING while the run ends.
    reference: Reference
    state: RobotState  # Measured before the command of this tick.
    openings: dict[str, float]  # Openings of the grippers, measured before the command of this tick.
    tools: dict[str, pin.SE3]  # Measured poses of the tools, in the world frame.
    command: Command  # The command that the plant got.
    events: list[Event]  # Events of teleoperation.
    grippers: dict[str, float]  # Openings measured after the plant has advanced.
    compute_time: float  # Time from polling the input to the command [s].
    impedance: ImpedanceReport | None = None  # None unless in torque mode.
    wall: WallReport | None = None  # None unless in torque mode.
    admittance: AdmittanceReport | None = None  # None unless in position mode with an admittance.
    held_grippers: dict[str, tuple[str, str]] = field(default_factory=dict)  # See :attr:`ControlLoop.held_grippers`.
    holding: dict[str, bool] = field(default_factory=dict)  # For each arm with an object, whether its gripper holds it.
    obstacles: dict[str, ObstacleReport] = field(default_factory=dict)  # The last reports of moving obstacles.
    chunks: list[ActionChunk] = field(default_factory=list)  # New action chunks of a policy.
    interventions: dict[str, bool] = field(default_factory=dict)  # For each arm, whether a hand replaces a policy.
    sessions: dict[str, str] = field(default_factory=dict)  # The state of each arm's session in words, if it has any.

    def by_policy(self, arm: str) -> bool:
        """Whether a policy moves the arm."""
        return self.states[arm] == ArmState.POLICY

    def tracking_error(self, arm: str) -> tuple[float, float]:
        """Return the distance [m] and the angle [rad] of an arm's tool from its target.

        Both are NaN if the arm has no target.
        """
        target = self.targets[arm].pose
        if target is None:
            return math.nan, math.nan
        tool, asked = pin.SE3ToXYZQUATtuple(self.tools[arm]), pin.SE3ToXYZQUATtuple(target)
        apart = min(math.dist(tool[3:], asked[3:]), math.dist(tool[3:], [-value for value in asked[3:]]))
        # A quaternion and its negative are the same rotation, so ``apart`` is the smaller of both distances.
        return math.dist(tool[:3], asked[:3]), 4.0 * math.asin(min(0.5 * apart, 1.0))
