"""The record of one tick, which listeners get."""

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
    """Where a run began, by the clock of its loop and by its plant."""

    now: float  # [s]
    state: RobotState


@dataclass(slots=True)
class Tick:
    """All that came in and went out in one tick, for the listeners; nobody changes it."""

    t: float  # since the start of the run [s]
    start: RunStart
    now: float  # by the loop's own clock, the one of the samples' stamps [s]
    dt: float  # that passed since the last tick [s]
    step: float  # by which the reference moved, less than dt where motion is stretched after a late tick [s]
    following: bool  # False: the run ends, and input and targets do not count any more
    connected: bool  # whether the input was
    samples: list[HandSample]
    targets: dict[str, ArmTarget]  # as the operator asks for them, whatever an admittance makes of them
    engaged: dict[str, bool]
    states: dict[str, str]  # of the teleop layer, or STOPPING
    reference: Reference
    state: RobotState  # measured before the tick's command
    openings: dict[str, float]  # of the grippers, measured before the tick's command
    tools: dict[str, pin.SE3]  # measured tool poses, world frame
    command: Command  # given to the plant
    events: list[Event]  # of the arms' teleoperation
    grippers: dict[str, float]  # openings measured after the plant has advanced
    compute_time: float  # [s]
    impedance: ImpedanceReport | None = None  # of torque mode
    wall: WallReport | None = None  # of torque mode
    admittance: AdmittanceReport | None = None  # of position mode, where it is enabled
    held_grippers: dict[str, tuple[str, str]] = field(default_factory=dict)  # see :attr:`ControlLoop.held_grippers`
    holding: dict[str, bool] = field(default_factory=dict)  # arm whose gripper has an object -> whether it holds it
    obstacles: dict[str, ObstacleReport] = field(default_factory=dict)  # that move by themselves, as reported last
    chunks: list[ActionChunk] = field(default_factory=list)  # of a policy, as they came
    interventions: dict[str, bool] = field(default_factory=dict)  # arm -> whether a hand moves it instead of a policy
    sessions: dict[str, str] = field(default_factory=dict)  # of arms that follow during sessions only, in words

    def by_policy(self, arm: str) -> bool:
        """Whether a policy moves the arm."""
        return self.states[arm] == ArmState.POLICY

    def tracking_error(self, arm: str) -> tuple[float, float]:
        """Distance [m] and angle [rad] of an arm's tool from its target; NaN where it has none."""
        target = self.targets[arm].pose
        if target is None:
            return math.nan, math.nan
        tool, asked = pin.SE3ToXYZQUATtuple(self.tools[arm]), pin.SE3ToXYZQUATtuple(target)
        apart = min(math.dist(tool[3:], asked[3:]), math.dist(tool[3:], [-value for value in asked[3:]]))
        return math.dist(tool[:3], asked[:3]), 4.0 * math.asin(min(0.5 * apart, 1.0))  # q and -q are one rotation
