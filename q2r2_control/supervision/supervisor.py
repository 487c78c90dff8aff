"""When the controller may move the arms: activation, loss, pause, stop, homing. The same object for every loop.

    inactive --joint states good and at rest--> active --fault--> braking --at rest--> inactive
                                                active --stop--> braking --at rest--> stopped --reset--> inactive

Inactive and stopped command nothing more, so that whatever else holds the arms is not disturbed. Activation starts the
reference at the measured posture and forgets all targets: nothing moves until a stream of targets begins anew at the
tool, see :mod:`target_stream`. At a fault the arms brake along the controller's certified stop, and hold where they
come to rest. Knows no ROS and no clock: times are passed in.
"""

from __future__ import annotations

from collections.abc import Callable
from enum import StrEnum

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.robot.robot import Robot
from q2r2_control.robot.stop_torque import joints_that_cannot_hold
from q2r2_control.supervision.arm_skew import SkewWatch
from q2r2_control.supervision.homing import Homing
from q2r2_control.supervision.joint_watch import ExternalArms, JointWatch, WatchSettings
from q2r2_control.supervision.standstill import StandingArms, StandstillLimits
from q2r2_control.supervision.target_stream import Origins, StreamSettings
from q2r2_control.supervision.targets import TargetStreams
from q2r2_control.types import Array, Reference, RobotState

_REST = 1e-4  # of the reference [rad/s]
# A joint that stands still this far from the reference may have nothing that moves it [rad], [rad/s].
_OFF_REFERENCE, _STILL = 0.02, 0.05

# The mode of driving changes targets by the measured state and a time [s]: an admittance displaces them.
Displace = Callable[[dict[str, pin.SE3 | None], RobotState, float], dict[str, pin.SE3 | None]]


class Phase(StrEnum):
    INACTIVE = "inactive"  # waits for joint states that are good and at rest
    ACTIVE = "active"
    BRAKING = "braking"
    STOPPED = "stopped"  # until it is reset


class Supervisor:
    """Decides at every tick what the controller is asked for, and whether its reference is commanded.

    With ``external`` the reference only leads arms that another controller moves.
    """

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
        """``standstill``: when what moves the arms counts as standing still; None: it is part of this program."""
        self._robot, self._controller, self._external, self._displace = robot, controller, external, displace
        self._origins = origins or Origins()
        self.targets = TargetStreams(robot.arms, streams, self._origins)
        self._watch = JointWatch(robot.joint_names, robot.velocity_limit, watch, self._origins.joint_states)
        self.skew = SkewWatch()
        self.homing = Homing(robot, controller, tools_only=external is not None)
        self._standing = None if standstill is None else StandingArms(robot, standstill, self._origins.takers)
        self._stopped: Reason | None = None  # why it takes a reset
        self._last: Reference | None = None
        self.phase = Phase.INACTIVE
        self.paused = False
        self.events: list[Reason] = []  # for the log; its writer clears them

    @property
    def fault(self) -> Reason | None:
        """Why nothing is commanded, or why the arms brake."""
        fault = self._stopped or self._watch.fault
        if fault is not None and fault.kind is ReasonKind.NO_STATES_YET:
            return Reason.of(fault.kind, source=self._origins.joint_states())
        return fault

    @property
    def state_fault(self) -> Reason | None:
        """Why the newest measured state cannot be believed, or None."""
        return self._watch.fault

    @property
    def state(self) -> RobotState | None:
        """The newest measured state that was good."""
        return self._watch.state

    @property
    def trusted(self) -> bool:
        """Whether the arms move, or hold, by joint states that are good."""
        return self.phase in (Phase.ACTIVE, Phase.BRAKING) and self._watch.fault is None

    def arm_state(self, arm: str) -> str:
        """The activity of one arm: following, homing or holding; or why no arm does anything."""
        if self.phase is not Phase.ACTIVE:
            return str(self.phase)
        if self.homing.active:
            return "homing"
        return "following" if self.follows(arm) else "holding"

    def follows(self, arm: str) -> bool:
        return self.phase is Phase.ACTIVE and self.targets.follows(arm)

    @property
    def measured(self) -> bool:
        """Whether the arms can brake by the newest state, also those that lost their session or have it again."""
        return self._watch.believed

    def update_state(
        self, state: RobotState | Reason, now: float, passed: float = 0.0, lost: Reason | None = None
    ) -> None:
        """A joint state, or what is wrong with it; ``passed`` [s]: see :meth:`JointWatch.observe`.

        ``lost``: why arms cannot be commanded although they are measured.
        """
        before = self._watch.fault
        if lost is None or isinstance(state, Reason):
            self._watch.observe(state, now, passed)
        else:
            self._watch.lose(lost)
        fault = self._watch.fault
        if self.phase is Phase.INACTIVE and fault is not None and fault != before:
            self.events.append(Reason(ReasonKind.JOINT_STATES, cause=fault))

    def update_target(
        self, arm: str, pose: pin.SE3 | None, now: float, number: int | None = None, due: float | None = None
    ) -> Reason | None:
        """A target in the world frame, or None for one that was no pose; returns why it is not followed, or None.

        ``number``: among its publisher's messages, where known; ``due``: when it is to be reached [s], None: at once.
        """
        tools: list[pin.SE3] = []
        if not self.targets.follows_on(arm, now):
            tools.append(self._controller.tool_pose(arm))
            if self._external is None and self._watch.state is not None:
                tools.append(self._robot.tool_pose(self._watch.state.q, arm))
        return self.targets.offer(arm, pose, tools, now, number, self.no_targets, due)

    @property
    def no_targets(self) -> Reason | None:
        """Why no arm may follow targets now, or None."""
        if self.phase is not Phase.ACTIVE:
            return Reason.of(ReasonKind.CONTROLLER_PHASE, phase=str(self.phase))
        if self.paused:
            return Reason(ReasonKind.CONTROLLER_PAUSED)
        return Reason(ReasonKind.ARMS_HOMING) if self.homing.active else None

    def tick(self, now: float, dt: float, posture: Array | None = None) -> Reference | None:
        """Move on by ``dt`` [s]; the reference to be commanded, or None.

        ``posture`` (nv,) [rad]: where joints go that the targets leave free; None: home.
        """
        if self.phase is Phase.INACTIVE:
            if self._watch.settled(now):
                self._activate()
            return None
        # Also while the arms brake and are held: a state that is lost then must not drive them any more.
        fault = self._watch.check(now)
        if self.phase is Phase.STOPPED:
            return None
        if self.phase is Phase.ACTIVE and fault is not None:
            self._brake(Reason(ReasonKind.JOINT_STATES, cause=fault))
        elif apart := self.skew.fault(now):
            self.start_over(apart, now)
        self.events += self.targets.expire(now)
        targets = self.homing.targets(self._last, dt) if self.homing.active else self.targets.at(now)
        self._last = reference = self._step(targets, dt, posture)
        if self.phase is Phase.ACTIVE:
            self._compare(reference, now)
            if outcome := self.homing.check(reference):
                self.events.append(Reason(ReasonKind.HOMING_OUTCOME, cause=outcome))
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
        """Whether the arms are where the reference is. Those that another controller moves may have none that does."""
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
        """The same, with the torque against gravity where that is more than the joint has."""
        torques = joints_that_cannot_hold(self._robot, reference.q).get(away.detail["joint"])
        if torques is None:
            return away
        needed, limit = torques
        return Reason.of(ReasonKind.TOO_HEAVY, **away.detail, needed=needed, limit=limit)

    def pause(self, paused: bool) -> None:
        """Hold all arms where they come to rest, or allow new streams of targets."""
        self.paused = paused
        self._forget_targets()

    def stalled(self, duration: float, now: float) -> None:
        """The loop stood still for ``duration`` [s], and something else may have moved the arms meanwhile.

        They rest by themselves, so there is nothing to brake, and going on from the reference could be a jump. They are
        activated anew where they rest; targets that waited are no new stream.
        """
        if self.phase not in (Phase.ACTIVE, Phase.BRAKING):
            return
        fault = Reason.of(ReasonKind.LOOP_STALLED, duration=duration)
        self._watch.observe(fault, now)
        self._brake(fault)
        self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED

    @property
    def off_reference(self) -> bool:
        """Whether a joint stands still away from the reference: maybe nothing moves it. A joint that lags moves."""
        state = self._watch.state
        if self.phase is not Phase.ACTIVE or self._last is None or state is None:
            return False
        return bool(((np.abs(state.q - self._last.q) > _OFF_REFERENCE) & (np.abs(state.v) < _STILL)).any())

    def let_go(self, fault: Reason, now: float) -> None:
        """Nothing takes an active arm's commands, or something else than before.

        Then nothing more is commanded, not even the way to rest, which would be a jump to the new receiver.
        """
        if self.phase is Phase.ACTIVE:
            self.start_over(fault, now)
            self.phase = Phase.INACTIVE

    def start_over(self, fault: Reason, now: float) -> None:
        """The arms do not go where the reference goes: brake, and be activated anew where the arms are then."""
        if self.phase is Phase.ACTIVE:
            self._watch.observe(fault, now)
            self._brake(fault)

    def stop(self, why: Reason) -> None:
        """Brake, and command nothing until :meth:`reset`."""
        self._stopped = why
        self._brake(why)
        if self.phase is Phase.INACTIVE:
            self.phase = Phase.STOPPED

    def reset(self) -> Reason | None:
        """Forget faults, stop, pause and all targets. Returns why that is not possible now, or None."""
        if self.phase is Phase.BRAKING:
            return Reason(ReasonKind.ARMS_BRAKING)
        self._stopped, self.paused = None, False
        self.targets.reset()
        self.homing.end()
        if self.phase is Phase.STOPPED:
            self.phase = Phase.INACTIVE
        return None

    def go_home(self, goal: Array | None = None) -> Reason | None:
        """Begin the way home, or as :meth:`Homing.begin` does. Returns why that is not possible now, or None."""
        if self.paused:
            return Reason(ReasonKind.CONTROLLER_PAUSED)
        if self.phase is not Phase.ACTIVE:
            return Reason.of(ReasonKind.CONTROLLER_PHASE, phase=str(self.phase))
        self._forget_targets()
        self.homing.begin(goal)
        return None

    def activate(self, state: RobotState, now: float) -> None:
        """Start at once at ``state``, at which the arms are known to be at rest. Raises :class:`RobotError`."""
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
        self.events.append(Reason(ReasonKind.ACTIVATED))

    def _brake(self, why: Reason) -> None:
        self._forget_targets()
        self.events.append(why)
        if self.phase is Phase.ACTIVE:
            self.phase = Phase.BRAKING

    def _forget_targets(self) -> None:
        self.homing.end()
        self.targets.drop()
