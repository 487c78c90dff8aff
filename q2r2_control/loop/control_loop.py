"""Compute one tick of control, from measured joints and targets to a command. Find what the operator's hands feel."""

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

_PROVEN = Phase.ACTIVE, Phase.BRAKING  # Only in these phases are openings of grippers certified.


@dataclass(slots=True)
class LoopStep:
    """The result of one tick."""

    reference: Reference | None  # None if nothing is commanded.
    command: Command | None  # The command for the plant; None if nothing is commanded.
    grippers: dict[str, float]  # Commanded openings, from 0 for closed to 1 for fully open.
    trusted: bool  # True if the command may be computed from the measured state.
    report: DriveReport
    refusals: dict[str, Reason] = field(default_factory=dict)  # For each arm that refuses its target, the reason.


# In each tick, the longest recent lag is multiplied by this factor, and so is forgotten slowly.
_REMEMBERED_LAG = 0.999
_SAME_TIME = 1e-6  # A difference of times below this counts as rounding [s].


class ControlLoop:
    """Calls supervision, grippers, controller and drive in the order that one tick needs.

    In each tick the caller uses :meth:`pace`, :meth:`observe` for each measured state that came, and :meth:`step`. The
    caller gives all times [s]. Held objects and openings of fingers are updated before the controller's step, which is
    certified with them.
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
        """Make a loop.

        Args:
            controller: The controller.
            drive: Turns the reference into commands of the plant.
            period: Time between two commands [s].
            streams: The rules for streams of targets.
            watch: The limits for measured states.
            origins: See :class:`Supervisor`.
            external: See :class:`Supervisor`.
            owns_plant: Whether this loop also sends commands while the arms are stopped. If False, it sends none then,
                and another controller holds the arms.
            gripper_delay: The longest time until a gripper gets its command [s].
            standstill: See :class:`Supervisor`.
        """
        robot = controller.robot
        self.controller, self.drive, self._owns_plant = controller, drive, owns_plant
        self.supervisor = Supervisor(robot, controller, streams, watch, origins, external, drive.displaced, standstill)
        self.acceleration_limit: Array = robot.capped_acceleration(controller.settings.acceleration_limit)
        velocity_limit = robot.velocity_limit * controller.settings.velocity_scale
        self.pacer = TickPacer(period, velocity_limit, self.acceleration_limit, drive.coasts)
        self._delay = max(gripper_delay, REMEMBERED)
        self._grasps = GraspWatch(controller, STALL + gripper_delay)
        self._limiter: GripperLimiter | None = None  # None while the reference may differ from the arms' posture.
        self._kept: Array = controller.kept_distances  # The kept distances that the drive knows [m].
        self._still: Mapping[str, MovingObstacle] = {}  # The obstacles at rest that the drive knows.
        self.holding: dict[str, bool] = {}  # For each arm that has an object, whether its gripper holds the object.
        self.granted_openings: dict[str, tuple[float, float]] = {}  # For each arm, the wanted and the granted opening.
        self._lags = MeasuredLags(robot)
        self._usual_lag = 0.0  # The longest recent lag [s].
        # For each arm whose driver does not report its lag, the time at which the arm was measured [s].
        self._untold: dict[str, float] = {}
        self._velocity = np.zeros(robot.model.nv)  # Joint velocities of the last reference [rad/s].
        self._first: float | None = None  # Time of the first tick [s].
        self._aged = 0.0  # Time by which reports of moving obstacles have aged since the first tick [s].

    @property
    def held_grippers(self) -> dict[str, tuple[str, str]]:
        """For each gripper that is not commanded to its wanted opening, the pair of bodies that prevents this."""
        return {} if self._limiter is None else self._limiter.held

    def pace(self, gap: float) -> float:
        """Return the time by which the reference advances [s], ``gap`` [s] after the last tick.

        See :meth:`TickPacer.step`.
        """
        return self.pacer.step(gap, self._velocity)

    def observe(self, state: RobotState | Reason, now: float, passed: float = 0.0, lost: Reason | None = None) -> None:
        """Pass a measured state to supervision, or the reason why there is no state; see :meth:`JointWatch.observe`.

        ``lost`` is the reason why the arms cannot be commanded although they are measured. An arm that can still be
        commanded then brakes from this state until it rests.
        """
        self.supervisor.update_state(state, now, passed, lost)

    def watch_skew(self, timings: Mapping[str, ArmTiming], lead: float, now: float) -> None:
        """Let supervision compare the lags of arms, each of which follows the reference with its own lag.

        The caller calls this method before a step and before an activation. The controller then keeps the arms apart
        for every difference of their lags that may occur.

        Args:
            timings: The timing of each arm's messages.
            lead: Longest time from the newest posture that was sent to an arm to the end of the newest step of the
                reference [s]. See :meth:`SessionPlant.lead`.
            now: The time [s].
        """
        self._untold = untold = {arm: now - its.silent for arm, its in timings.items() if its.behind is None}
        if untold and (state := self.supervisor.state) is not None:
            behind = self._lags.behind(state.q, untold)
            timings = {arm: replace(its, behind=behind.get(arm, its.behind)) for arm, its in timings.items()}
            self._usual_lag = max(_REMEMBERED_LAG * self._usual_lag, *behind.values())
            # An arm whose driver reports no lag may be this far behind the posture that it was sent.
            lead += self._usual_lag
        self.controller.allow_skew(min(skew_window(timings, lead), LONGEST_WINDOW))
        self.supervisor.skew.observe(timings, now)

    def activate(self, state: RobotState, now: float) -> None:
        """Activate the arms at once, because the caller knows that they are at rest at ``state``.

        Raises:
            Q2R2Error: If the controller cannot start at ``state``.
        """
        self.supervisor.activate(replace(state, stamp=now), now)
        self._begin(state, {}, now)

    def wait(self, state: RobotState) -> None:
        """Stay inactive until the states are good and the arms rest, see :class:`Supervisor`. Begin at ``state``."""
        self.controller.reset(state.q)
        self.drive.reset(state)

    def resume_gripper(
        self, arm: str, wanted: float, commanded: float, openings: Mapping[str, float], now: float
    ) -> None:
        """Let a gripper stay at the opening to which another program has ``commanded`` it."""
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
        """Advance by one tick.

        Args:
            state: The newest measured state, which :meth:`observe` has seen; None if there is none.
            targets: Targets of the tools in the world frame, by arm; None lets the arm hold. An arm whose targets come
                as messages is missing here.
            now: The time [s].
            dt: Time by which the reference advances [s].
            grippers: The wanted openings, from 0 for closed to 1 for fully open.
            openings: The measured openings.
            braked: Time for which the plant has followed the certified stop by itself before this tick [s].
            posture: The posture that the joints approach as far as the targets leave them free (nv,) [rad]; None for
                the home posture.

        Returns:
            The reference and the command for the plant.
        """
        self.age_obstacles(now)
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
            reference = self.controller.brake(dt)  # The arms go on along their certified stop until they rest.
        self._aged += braked if reference is None else braked + dt
        if reference is None:
            self._lags.restart()
        elif self._untold:
            self._lags.note(reference.q, now)
        if self.controller.kept_distances is not self._kept:  # The step may have changed the kept distances.
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

    def age_obstacles(self, now: float) -> None:
        """Let reports of moving obstacles age by the clock, up to ``now`` [s].

        The reports age from the first call on. A step of the controller ages them only by the time by which it advances
        the reference. This time is shorter than the clock's time if the loop stalls, and zero while the arms are not
        commanded. This method adds the rest. Every :meth:`step` calls it. A caller calls it before it passes on a new
        report whose age counts from ``now``.
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
        """Return the openings to be commanded, and find out whether the grippers hold something.

        While the arms do not move, nothing is certified, and a gripper gets the wanted opening, for instance to release
        an object. There is one exception: a gripper that did not get its wanted opening before the arms stopped does
        not move farther in that direction.
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
        """Let grippers and drive begin at ``state``, where the controller was reset.

        Grippers still count as holding the objects that they held before the reset.
        """
        self._grasps.tell_again()
        self._limiter = GripperLimiter(self.controller, self._delay)
        self._tell_holding()
        self.drive.reset(state)
        self._limiter.resume({arm: granted for arm, (_, granted) in self.granted_openings.items()}, openings, now)
        self._kept = self.controller.kept_distances
        self.drive.set_openings(self.controller.openings)
        self.drive.set_kept_distances(self._kept)


def without_proof(wanted: float, before: tuple[float, float] | None) -> float:
    """Return the opening that a gripper gets while the arms do not move, and nothing is certified.

    A gripper gets the wanted opening, with one exception: a gripper that did not get its wanted opening before does not
    move farther in that direction.

    Args:
        wanted: The wanted opening.
        before: The wanted and the granted opening of the last tick; None if there is none.
    """
    if before is None or before[0] == before[1]:
        return wanted
    return min(wanted, before[1]) if before[0] > before[1] else max(wanted, before[1])


_LIMIT_LASTS = 0.5  # A limit that has limited a step counts as reached for this time [s].


class ArmConditions:
    """Finds the conditions that an operator's hand feels, from controller and measured state.

    Times are the loop's [s].
    """

    def __init__(self, controller: CartesianController) -> None:
        robot = controller.robot
        self._controller, self._robot = controller, robot
        self._data = robot.model.createData()
        self._joints = {arm: {robot.joint_names[j] for j in robot.arms[arm].joints} for arm in robot.arms}
        self._limited: dict[str, float] = {}  # Time at which each joint was last at its position limit [s].

    def note(self, report: StepReport, now: float) -> None:
        """Remember the limits that have limited a step. It is called in every tick."""
        for kind, names in report.binding:
            if kind is LimitKind.POSITION:
                self._limited[names[0]] = now

    def look(self, state: RobotState, now: float) -> Mapping[str, ArmCondition]:
        """Return the conditions of every arm at ``now``."""
        return {arm: self.look_at(arm, state, now) for arm in self._joints}

    def look_at(self, arm: str, state: RobotState, now: float) -> ArmCondition:
        """Return the conditions of one arm at ``now``. Distances are measured, which is too slow for every tick."""
        self._limited = {name: t for name, t in self._limited.items() if now - t <= _LIMIT_LASTS}
        limited = frozenset(self._joints[arm] & self._limited.keys())
        return ArmCondition(self._controller.spare_distance(arm), limited, self._contact_force(arm, state))

    def _contact_force(self, arm: str, state: RobotState) -> float | None:
        """Return the contact force that an admittance would estimate [N]; None if no torque is measured."""
        if state.tau_external is None or not np.isfinite((state.tau_external, state.q)).all():
            return None
        chosen = self._robot.arms[arm]
        J = pin.computeFrameJacobian(self._robot.model, self._data, state.q, chosen.frame_id, pin.LOCAL_WORLD_ALIGNED)
        wrench = estimate_wrench(J[:, chosen.joints], state.tau_external[chosen.joints])
        return math.hypot(*wrench[:3].tolist())
