"""One tick of control, from measured joints and targets to a command, and the conditions that a hand feels."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.admittance import estimate_wrench
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.controller import CartesianController
from q2r2_control.control.safety.reference_history import LONGEST_WINDOW
from q2r2_control.drives.base import Drive, DriveReport
from q2r2_control.events import Reason
from q2r2_control.supervision.arm_skew import skew_window
from q2r2_control.supervision.gripper_limiter import REMEMBERED, STALL, GraspWatch, GripperLimiter
from q2r2_control.supervision.joint_watch import ExternalArms, WatchSettings
from q2r2_control.supervision.measured_lags import MeasuredLags
from q2r2_control.supervision.standstill import StandstillLimits
from q2r2_control.supervision.supervisor import Phase, Supervisor
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.supervision.tick_pacer import TickPacer
from q2r2_control.teleop.haptics import ArmCondition
from q2r2_control.types import ArmTiming, Array, Command, LimitKind, Reference, RobotState, StepReport

_PROVEN = Phase.ACTIVE, Phase.BRAKING  # in other phases no opening of a gripper is proven


@dataclass(slots=True)
class LoopStep:
    """The result of one tick."""

    reference: Reference | None  # None: nothing is commanded
    command: Command | None  # for the plant; None: nothing is commanded
    grippers: dict[str, float]  # commanded openings, 0 closed .. 1 fully open
    trusted: bool  # whether the command may go by the measured state
    report: DriveReport
    refusals: dict[str, Reason] = field(default_factory=dict)  # arm -> why its target is not followed


_REMEMBERED_LAG = 0.999  # share of the longest lag lately that a tick leaves
_SAME_TIME = 1e-6  # [s]; less is rounding


class ControlLoop:
    """Supervision, controller, grippers and drive, in the order that one tick needs.

    In each tick: :meth:`pace`, :meth:`observe` for each measured state that came, and :meth:`step`. Times are the
    caller's [s]. Held objects and finger openings are known before the controller's step, which is proven with them.
    """

    def __init__(
        self,
        controller: CartesianController,
        drive: Drive,
        period: float,
        streams: StreamSettings,
        watch: WatchSettings,
        *,
        origins: Origins | None = None,
        external: ExternalArms | None = None,
        gripper_delay: float = 0.0,
        owns_plant: bool = True,
        standstill: StandstillLimits | None = None,
    ) -> None:
        """``period`` [s] of the commands; ``gripper_delay`` [s]: until a gripper gets its command, at most.

        ``owns_plant``: commands go on while the arms are stopped. Otherwise whatever else holds them is left alone.
        ``standstill``: see :class:`Supervisor`.
        """
        robot = controller.robot
        self.controller, self.drive, self._owns_plant = controller, drive, owns_plant
        self.supervisor = Supervisor(robot, controller, streams, watch, origins, external, drive.displaced, standstill)
        self.acceleration_limit: Array = robot.capped_acceleration(controller.settings.acceleration_limit)
        velocity_limit = robot.velocity_limit * controller.settings.velocity_scale
        self.pacer = TickPacer(period, velocity_limit, self.acceleration_limit, drive.coasts)
        self._delay = max(gripper_delay, REMEMBERED)
        self._grasps = GraspWatch(controller, STALL + gripper_delay)
        self._limiter: GripperLimiter | None = None  # while the controller's reference is where the arms are
        self._kept: Array = controller.kept_distances  # that the drive was told of [m]
        self._still: Mapping[str, MovingObstacle] = {}  # obstacles that the drive was told of
        self.holding: dict[str, bool] = {}  # of each arm that has an object, whether its gripper holds it
        self.granted_openings: dict[str, tuple[float, float]] = {}  # arm -> opening that was wanted, and granted
        self._lags = MeasuredLags(robot)
        self._usual_lag = 0.0  # the longest one that was found lately [s]
        self._untold: dict[str, float] = {}  # when arms were measured whose drivers do not tell how far they are [s]
        self._velocity = np.zeros(robot.model.nv)  # of the last reference [rad/s]
        self._first: float | None = None  # time of the first tick [s]
        self._aged = 0.0  # by how much reports of moving obstacles became older since then [s]

    @property
    def held_grippers(self) -> dict[str, tuple[str, str]]:
        """Arm -> pair of bodies that keeps its gripper from being commanded as wanted."""
        return {} if self._limiter is None else self._limiter.held

    def pace(self, gap: float) -> float:
        """Time [s] for the reference to move by, ``gap`` [s] after the last tick; see :meth:`TickPacer.step`."""
        return self.pacer.step(gap, self._velocity)

    def observe(self, state: RobotState | Reason, now: float, passed: float = 0.0, lost: Reason | None = None) -> None:
        """Let supervision see a measured state, or the reason why there is none; see :meth:`JointWatch.take`.

        ``lost``: why the arms cannot be commanded although they are measured. Those that still can brake by the state,
        until they rest.
        """
        self.supervisor.update_state(state, now, passed, lost)

    def watch_skew(self, timings: Mapping[str, ArmTiming], lead: float, now: float) -> None:
        """Let supervision compare arms that follow the reference each on its own, before a step and an activation.

        ``lead``: from where they are led to the end of the newest step [s]. They are kept apart for all that they may
        be apart in time.
        """
        self._untold = untold = {arm: now - its.silent for arm, its in timings.items() if its.behind is None}
        if untold and (state := self.supervisor.state) is not None:
            behind = self._lags.behind(state.q, untold)
            timings = {arm: replace(its, behind=behind.get(arm, its.behind)) for arm, its in timings.items()}
            self._usual_lag = max(_REMEMBERED_LAG * self._usual_lag, *behind.values())
            lead += self._usual_lag  # such arms are led from where they are
        self.controller.allow_skew(min(skew_window(timings, lead), LONGEST_WINDOW))
        self.supervisor.skew.observe(timings, now)

    def activate(self, state: RobotState, now: float) -> None:
        """Start at once at ``state``, at which the arms are known to be at rest. Raises :class:`Q2R2Error`."""
        self.supervisor.activate(replace(state, stamp=now), now)
        self._begin(state, {}, now)

    def wait(self, state: RobotState) -> None:
        """Begin inactive at ``state``, until it is good and at rest; see :class:`Supervisor`."""
        self.controller.reset(state.q)
        self.drive.reset(state)

    def resume_gripper(
        self, arm: str, wanted: float, commanded: float, openings: Mapping[str, float], now: float
    ) -> None:
        """Let a gripper that was ``commanded`` to an opening by another program stay as it is."""
        self.granted_openings[arm] = wanted, commanded
        if self._limiter is not None:
            self._limiter.resume({arm: commanded}, openings, now)

    def step(
        self,
        state: RobotState | None,
        targets: Mapping[str, pin.SE3 | None],
        now: float,
        dt: float,
        grippers: Mapping[str, float],
        openings: Mapping[str, float],
        braked: float = 0.0,
        posture: Array | None = None,
    ) -> LoopStep:
        """Move on by ``dt`` [s], after ``braked`` [s] of the certified stop, which the plant has begun by itself.

        ``state`` is the newest measured one, which was observed; ``targets`` are tool poses in the world frame, None:
        the arm holds. An arm whose targets come as messages is not among them. ``grippers`` are wanted openings,
        ``openings`` the measured ones, 0 closed .. 1 fully open. ``posture`` (nv,) [rad]: where
        joints go that the targets leave free; None: home.
        """
        self._age_obstacles(now)
        supervisor, refusals = self.supervisor, {}
        for arm, pose in targets.items():
            if pose is None:
                supervisor.targets.release(arm)
            elif refusal := supervisor.update_target(arm, pose, now):
                refusals[arm] = refusal
        if braked > 0.0:
            self.controller.brake(braked)
        commanded = self.limit_grippers(grippers, openings, now)
        was_inactive = supervisor.phase is Phase.INACTIVE
        reference = supervisor.tick(now, dt, posture)
        if was_inactive and supervisor.phase is Phase.ACTIVE and state is not None:
            self._begin(state, openings, now)
        if reference is None and self._owns_plant:
            reference = self.controller.brake(dt)  # the rest of the arms' motion
        self._aged += braked if reference is None else braked + dt
        if reference is None:
            self._lags.restart()
        elif self._untold:
            self._lags.note(reference.q, now)
        if self.controller.kept_distances is not self._kept:  # the step may have taken up others
            self._kept = self.controller.kept_distances
            self.drive.set_kept_distances(self._kept)
        if self.controller.still_obstacles is not self._still:
            self._still = self.controller.still_obstacles
            self.drive.set_obstacles(self._still)
        trusted = supervisor.measured if self._owns_plant else supervisor.trusted
        command = None
        if reference is not None and state is not None:
            self._velocity = reference.v
            command = self.drive.command(reference, state, commanded, dt, trusted)
            command.deceleration = self.controller.stop_deceleration
        return LoopStep(reference, command, commanded, trusted, self.drive.report, refusals)

    def _age_obstacles(self, now: float) -> None:
        """Let reports of moving obstacles be as old as the clock says.

        A step makes them older by the time that it moves the reference by. Less passes than on the clock while the loop
        stalls, and none while the arms are not commanded.
        """
        if self._first is None:
            self._first = now
        behind = now - self._first - self._aged
        if behind > _SAME_TIME:
            self.controller.pass_time(behind)
            self._aged += behind

    def limit_grippers(
        self, wanted: Mapping[str, float], measured: Mapping[str, float], now: float
    ) -> dict[str, float]:
        """The openings to be commanded; also finds out whether the grippers hold something.

        While the arms do not move, nothing is proven: a gripper gets what it wants, for instance to let go. But one
        that was held does not go on in that direction because the arms were stopped.
        """
        if not self._owns_plant and self.supervisor.phase not in _PROVEN:
            self._limiter, self.holding = None, {}
        if self._limiter is None:
            granted = self.granted_openings
            commanded = {arm: without_proof(opening, granted.get(arm)) for arm, opening in wanted.items()}
        else:
            commanded = self._limiter.limit(wanted, measured, now)
            if self._limiter.changed:
                self.drive.set_openings(self.controller.openings)
            if self._grasps.update(commanded, measured, now):
                self._tell_holding()
        for arm, opening in commanded.items():
            self.granted_openings[arm] = wanted[arm], opening
        return commanded

    def _tell_holding(self) -> None:
        self.holding = self.controller.holding
        self.drive.set_holding(self.holding)

    def _begin(self, state: RobotState, openings: Mapping[str, float], now: float) -> None:
        """The controller was reset at ``state``: bodies and drive begin there too, with the weight of held objects."""
        self._grasps.tell_again()
        self._limiter = GripperLimiter(self.controller, self._delay)
        self._tell_holding()
        self.drive.reset(state)
        self._limiter.resume({arm: granted for arm, (_, granted) in self.granted_openings.items()}, openings, now)
        self._kept = self.controller.kept_distances
        self.drive.set_openings(self.controller.openings)
        self.drive.set_kept_distances(self._kept)


def without_proof(wanted: float, before: tuple[float, float] | None) -> float:
    """The opening that is granted while the arms do not move; ``before``: wanted and granted before."""
    if before is None or before[0] == before[1]:
        return wanted
    return min(wanted, before[1]) if before[0] > before[1] else max(wanted, before[1])


_LIMIT_LASTS = 0.5  # a joint counts as at its limit for so long after it last was: limits bind on and off [s]


class ArmConditions:
    """Looks at a controller and at what was measured. Times are the loop's [s]."""

    def __init__(self, controller: CartesianController) -> None:
        robot = controller.robot
        self._controller, self._robot = controller, robot
        self._data = robot.model.createData()
        self._joints = {arm: {robot.joint_names[j] for j in robot.arms[arm].joints} for arm in robot.arms}
        self._limited: dict[str, float] = {}  # when a joint last was at its position limit [s]

    def note(self, report: StepReport, now: float) -> None:
        """Remember which limits held up a step; of every tick."""
        for kind, names in report.binding:
            if kind is LimitKind.POSITION:
                self._limited[names[0]] = now

    def look(self, state: RobotState, now: float) -> Mapping[str, ArmCondition]:
        """Of every arm, at ``now``."""
        return {arm: self.look_at(arm, state, now) for arm in self._joints}

    def look_at(self, arm: str, state: RobotState, now: float) -> ArmCondition:
        """Of one arm, at ``now``; less often than every tick, since distances take their time."""
        self._limited = {name: t for name, t in self._limited.items() if now - t <= _LIMIT_LASTS}
        limited = frozenset(self._joints[arm] & self._limited.keys())
        return ArmCondition(self._controller.spare_distance(arm), limited, self._contact_force(arm, state))

    def _contact_force(self, arm: str, state: RobotState) -> float | None:
        """As an admittance estimates it [N]; None where nothing is measured."""
        if state.tau_external is None or not np.isfinite((state.tau_external, state.q)).all():
            return None
        chosen = self._robot.arms[arm]
        J = pin.computeFrameJacobian(self._robot.model, self._data, state.q, chosen.frame_id, pin.LOCAL_WORLD_ALIGNED)
        wrench = estimate_wrench(J[:, chosen.joints], state.tau_external[chosen.joints])
        return math.hypot(*wrench[:3].tolist())
