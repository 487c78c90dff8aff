"""Decide when the controller may move the arms: activation, faults, pause, stop and homing. Every loop uses this class.

    inactive --joint states good and at rest--> active --fault--> braking --at rest--> inactive
                                                active --stop--> braking --at rest--> stopped --reset--> inactive

In the phases inactive and stopped nothing is commanded, so that the arms' own controller can hold them. Activation
starts the reference at the measured posture and forgets all targets. Nothing moves until a new stream of targets begins
at the tool, see :mod:`target_stream`. After a fault the arms brake along the controller's certified stop and hold where
they come to rest. This module imports no ROS and reads no clock: the caller gives the time.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum
from functools import partial

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.events import CommonReason, Reason
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import joints_that_cannot_hold
from q2r2_control.supervision.arm_skew import SkewWatch
from q2r2_control.supervision.homing import Homing
from q2r2_control.supervision.joint_watch import ExternalArms, JointWatch, WatchSettings
from q2r2_control.supervision.reasons import SupervisionReason
from q2r2_control.supervision.standstill import StandingArms, StandstillLimits
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.supervision.targets import TargetStreams
from q2r2_control.types import Array, Reference, RobotState

_REST = 1e-4  # The reference is at rest if no joint is faster than this [rad/s].
# If a joint is farther from the reference than the first value and slower than the second one, its driver may be gone
# [rad], [rad/s].
_OFF_REFERENCE, _STILL = 0.02, 0.05

# A function of an admittance. It gets the targets by arm, the measured state and a time step [s], and returns the
# displaced targets.
Displace = Callable[[dict[str, pin.SE3 | None], RobotState, float], dict[str, pin.SE3 | None]]


class Phase(StrEnum):
    INACTIVE = "inactive"  # The supervisor waits until the joint states are good and the arms rest.
    ACTIVE = "active"
    BRAKING = "braking"
    STOPPED = "stopped"  # Only a reset ends this phase.


class Supervisor:
    """Decides at every tick which targets the controller gets, and whether the plant gets its reference."""

    def __init__(
        self,
        robot: Robot,
        controller: CartesianController,
        streams: StreamSettings,
        watch: WatchSettings,
        origins: Origins | None = None,
        external: ExternalArms | None = None,
        displace: Displace | None = None,
        standstill: StandstillLimits | None = None,
    ) -> None:
        """Make a supervisor, in the phase inactive.

        Args:
            robot: The robot.
            controller: Its controller.
            streams: The rules for streams of targets.
            watch: The limits for measured states.
            origins: Names of the senders of targets and states, for messages.
            external: The checks for another controller, which moves the arms along the reference; None if there is no
                other controller.
            displace: The function of an admittance that displaces the targets; None without an admittance.
            standstill: The limits by which a driver counts as standing still; None if the driver is part of this
                program.
        """
        self._robot, self._controller, self._external, self._displace = robot, controller, external, displace
        self._origins = origins or Origins()
        self.targets = TargetStreams(robot.arms, streams, self._origins)
        self._watch = JointWatch(robot.joint_names, robot.velocity_limit, watch, self._origins.joint_states)
        self.skew = SkewWatch()
        self.homing = Homing(robot, controller, tools_only=external is not None)
        self._standing = None if standstill is None else StandingArms(robot, standstill, self._origins.takers)
        self._stopped: Reason | None = None  # Why the arms stop until a reset; None if they do not.
        self._reported: Reason | None = None  # The newest fault that the plant has reported by itself.
        self._last: Reference | None = None
        # Why arms that followed targets ceased to follow them; None after an arm follows targets again.
        self.ceased: Reason | None = None
        self.phase = Phase.INACTIVE
        self.paused = False
        self.events: list[Reason] = []  # Events for the log. The writer of the log clears the list.

    @property
    def fault(self) -> Reason | None:
        """Why nothing is commanded, or why the arms brake; None if there is no fault."""
        fault = self._stopped or self._watch.fault
        if fault is not None and fault.kind is SupervisionReason.NO_STATES_YET:
            return Reason.of(fault.kind, source=self._origins.joint_states())
        return fault

    @property
    def state_fault(self) -> Reason | None:
        """Why the newest measured state cannot be believed, or None."""
        return self._watch.fault

    @property
    def state(self) -> RobotState | None:
        """The newest measured state that was good; None if none has come yet."""
        return self._watch.state

    @property
    def trusted(self) -> bool:
        """Whether the phase is active or braking, and the joint states are good."""
        return self.phase in (Phase.ACTIVE, Phase.BRAKING) and self._watch.fault is None

    def arm_state(self, arm: str) -> str:
        """Return the activity of one arm: following, homing or holding; outside the phase active, the phase's name."""
        if self.phase is not Phase.ACTIVE:
            return str(self.phase)
        if self.homing.active:
            return "homing"
        return "following" if self.follows(arm) else "holding"

    def follows(self, arm: str) -> bool:
        return self.phase is Phase.ACTIVE and self.targets.follows(arm)

    @property
    def measured(self) -> bool:
        """Whether the arms may brake from the newest measured state, even if their session is lost."""
        return self._watch.believed

    def update_state(
        self, state: RobotState | Reason, now: float, passed: float = 0.0, lost: Reason | None = None
    ) -> None:
        """Take a joint state, or the reason why there is no state.

        Args:
            state: See :meth:`JointWatch.observe`.
            now: The time of the loop [s].
            passed: See :meth:`JointWatch.observe` [s].
            lost: Why the arms cannot be commanded although they are measured; None if they can.
        """
        before = self._watch.fault
        if lost is None or isinstance(state, Reason):
            self._watch.observe(state, now, passed)
        else:
            self._watch.lose(lost)
            if self._watch.fault is lost:  # An earlier fault is kept.
                self._reported = lost
        fault = self._watch.fault
        if self.phase is Phase.INACTIVE and fault is not None and fault != before:
            self.events.append(self._with_origin(fault))

    def _with_origin(self, fault: Reason) -> Reason:
        """Return ``fault`` as the cause of a reason which says whether the plant or the joint states told it."""
        kind = SupervisionReason.PLANT_FAULT if fault is self._reported else SupervisionReason.JOINT_STATES
        return Reason(kind, cause=fault)

    def update_target(
        self, arm: str, pose: pin.SE3 | None, now: float, number: int | None = None, due: float | None = None
    ) -> Reason | None:
        """Take a target of one arm; returns why it is not followed, or None.

        Args:
            arm: The arm.
            pose: The tool's target in the world frame; None if the message was not a pose.
            now: The time of receipt [s].
            number: The sequence number that the publisher gave the message; None if it is unknown.
            due: The time at which the tool should reach the target [s]; None if the tool should reach it at once.
        """
        refusal = self.targets.offer(arm, pose, partial(self._tools, arm), now, number, self.no_targets, due)
        if refusal is None and pose is not None:
            self.ceased = None
        return refusal

    def _tools(self, arm: str) -> list[pin.SE3]:
        """Return the poses at which a stream of targets may begin; see :meth:`TargetStream.offer`."""
        tools = [self._controller.tool_pose(arm)]
        if self._external is None and self._watch.state is not None:
            tools.append(self._robot.tool_pose(self._watch.state.q, arm))
        return tools

    @property
    def no_targets(self) -> Reason | None:
        """Why no arm may follow targets now, or None."""
        if self.phase is not Phase.ACTIVE:
            return Reason.of(SupervisionReason.CONTROLLER_PHASE, phase=str(self.phase))
        if self.paused:
            return Reason(SupervisionReason.CONTROLLER_PAUSED)
        return Reason(SupervisionReason.ARMS_HOMING) if self.homing.active else None

    def tick(self, now: float, dt: float, posture: Array | None = None) -> Reference | None:
        """Advance by one tick.

        Args:
            now: The time of the loop [s].
            dt: Time by which the reference advances [s].
            posture: The posture that the joints approach as far as the targets leave them free (nv,) [rad]; None for
                the home posture.

        Returns:
            The reference for the plant; None if nothing may be commanded.
        """
        if self.phase is Phase.INACTIVE:
            if self._watch.settled(now):
                self._activate()
            return None
        # The states are checked in every phase, because some drives need good states to brake.
        fault = self._watch.check(now)
        if self.phase is Phase.STOPPED:
            return None
        if self.phase is Phase.ACTIVE and fault is not None:
            self._brake(self._with_origin(fault))
        elif apart := self.skew.fault(now):
            self.start_over(apart, now)
        if ended := self.targets.expire(now):
            self.events += ended
            self.ceased = ended[-1]
        targets = self.homing.targets(self._last, dt) if self.homing.active else self.targets.at(now)
        self._last = reference = self._step(targets, dt, posture)
        if self.phase is Phase.ACTIVE:
            self._compare(reference, now)
            if outcome := self.homing.check(reference):
                self.events.append(Reason(SupervisionReason.HOMING_OUTCOME, cause=outcome))
        elif float(np.abs(reference.v).max()) <= _REST:
            self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED
        return reference

    def _step(self, targets: dict[str, pin.SE3 | None], dt: float, posture: Array | None) -> Reference:
        state = self._watch.state
        if self.phase is not Phase.ACTIVE or self.skew.holds:
            return self._controller.brake(dt)
        if state is None:
            return self._controller.step(targets, dt)
        if self._displace is not None:
            targets = self._displace(targets, state, dt)
        if self._external is None:
            return self._controller.step(targets, dt, posture)
        return self._controller.step(self._external.targets(targets, self._last), dt, state.q)

    def _compare(self, reference: Reference, now: float) -> None:
        """Compare the arms with the reference, and react if they deviate too much or if a driver stands still.

        Without an external controller, arms that deviate too much are stopped. With an external controller, they brake
        and are activated again, and they are stopped only if a pair is too close. If a driver stands still, the arms
        always brake and are activated again.
        """
        away, state = self._watch.deviates(reference.q, now), self._watch.state
        standing = None if self._standing is None or state is None else self._standing.look(reference.q, state, now)
        if standing is not None:
            self.targets.end(standing)
            self.start_over(standing, now)
            return
        if self._external is None or state is None:
            if away is not None:
                self.stop(self._with_gravity(away, reference))
        elif too_close := self._external.too_close(state):
            self.stop(too_close)
        else:
            holding = [arm for arm in self._robot.arms if not self.targets.follows(arm)]
            if behind := away or self._external.left_behind(state, holding, now):
                self.start_over(behind, now)

    def _with_gravity(self, away: Reason, reference: Reference) -> Reason:
        """Return the reason ``away``, or a more exact reason if the joint is too weak to bear the arm's weight."""
        torques = joints_that_cannot_hold(self._robot, reference.q).get(away.detail["joint"])
        if torques is None:
            return away
        needed, limit = torques
        return Reason.of(SupervisionReason.TOO_HEAVY, **away.detail, needed=needed, limit=limit)

    def pause(self, paused: bool) -> None:
        """If ``paused``, let all arms hold where they come to rest; otherwise allow new streams of targets."""
        self.paused = paused
        self._forget_targets()

    def stalled(self, duration: float, now: float) -> None:
        """Deactivate the arms after the loop stood still for ``duration`` [s].

        Meanwhile the arms have come to rest by themselves, and somebody may have moved them. A command at the old
        reference could make them jump. The arms are therefore activated again where they rest. Targets that waited
        during the standstill do not begin a new stream.
        """
        if self.phase not in (Phase.ACTIVE, Phase.BRAKING):
            return
        fault = Reason.of(CommonReason.LOOP_STALLED, duration=duration)
        self._watch.observe(fault, now)
        self._brake(fault)
        self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED

    @property
    def off_reference(self) -> bool:
        """Whether a joint stands still away from the reference. A joint that only lags still moves."""
        state = self._watch.state
        if self.phase is not Phase.ACTIVE or self._last is None or state is None:
            return False
        return bool(((np.abs(state.q - self._last.q) > _OFF_REFERENCE) & (np.abs(state.v) < _STILL)).any())

    def let_go(self, fault: Reason, now: float) -> None:
        """Command nothing more, because the receiver of an active arm's commands has gone or was replaced.

        Not even the certified stop is commanded: for a new receiver it would begin with a jump.
        """
        if self.phase is Phase.ACTIVE:
            self.start_over(fault, now)
            self.phase = Phase.INACTIVE

    def start_over(self, fault: Reason, now: float) -> None:
        """Brake because the arms do not follow the reference, and activate them again where they come to rest."""
        if self.phase is Phase.ACTIVE:
            self._watch.observe(fault, now)
            self._brake(fault)

    def stop(self, why: Reason) -> None:
        """Brake, and then command nothing until :meth:`reset`."""
        self._stopped = why
        self._brake(why)
        if self.phase is Phase.INACTIVE:
            self.phase = Phase.STOPPED

    def reset(self) -> Reason | None:
        """Clear all faults and targets, and end a stop or a pause.

        Returns the reason if that is not possible now, else None.
        """
        if self.phase is Phase.BRAKING:
            return Reason(SupervisionReason.ARMS_BRAKING)
        self._stopped, self.paused = None, False
        self.targets.reset()
        self.homing.end()
        if self.phase is Phase.STOPPED:
            self.phase = Phase.INACTIVE
        return None

    def go_home(self, goal: Array | None = None) -> Reason | None:
        """Begin the motion home, or the motion to ``goal``. Returns the reason if that is not possible now, else None.

        Args:
            goal: See :meth:`Homing.begin`.
        """
        if self.paused:
            return Reason(SupervisionReason.CONTROLLER_PAUSED)
        if self.phase is not Phase.ACTIVE:
            return Reason.of(SupervisionReason.CONTROLLER_PHASE, phase=str(self.phase))
        self._forget_targets()
        self.homing.begin(goal)
        return None

    def activate(self, state: RobotState, now: float) -> None:
        """Activate the arms at once, because the caller knows that they are at rest at ``state``.

        Raises:
            RobotError: If the controller cannot start at ``state``.
        """
        self._stopped, self.paused = None, False
        self.targets.reset()
        self._watch.accept_at_once(state, now)
        self._activate()

    def _activate(self) -> None:
        state = self._watch.state
        assert state is not None
        self._controller.reset(state.q if state.held is None else state.held)
        self._forget_targets()
        if self._external is not None:
            self._external.begin()
        self._watch.accept()
        self._last = None
        self.phase = Phase.ACTIVE
        self.events.append(Reason(SupervisionReason.ACTIVATED))

    def _brake(self, why: Reason) -> None:
        self._forget_targets()
        self.ceased = why
        self.events.append(why)
        if self.phase is Phase.ACTIVE:
            self.phase = Phase.BRAKING

    def _forget_targets(self) -> None:
        self.homing.end()
        self.targets.drop()
