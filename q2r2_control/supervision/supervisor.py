"""When the controller may move the arms: activation, loss, pause, stop, homing. Knows no ROS; times are passed in.

    inactive --joint states good and at rest--> active --fault--> braking --at rest--> inactive
                                                active --stop--> braking --at rest--> stopped --reset--> inactive

Inactive and stopped command nothing, so that whoever else holds the arms is not disturbed. Activation starts the
reference at the measured posture and forgets all targets: nothing moves until a stream of targets begins anew at the
tool, see :mod:`target_stream`. A fault brakes along the controller's certified stop.
"""

from __future__ import annotations

from enum import StrEnum

import numpy as np
import pinocchio as pin

from q2r2_control.control.controller import CartesianController
from q2r2_control.robot.robot import Robot
from q2r2_control.supervision.external_arms import LedArms
from q2r2_control.supervision.homing import Homing
from q2r2_control.supervision.joint_watch import NONE_YET, JointWatch, WatchSettings
from q2r2_control.supervision.sequence_watch import SequenceWatch
from q2r2_control.supervision.target_stream import Origins, Refusal, StreamSettings, TargetStream
from q2r2_control.types import Reference, RobotState

_REST = 1e-4  # of the reference [rad/s]
_ASTRAY, _STILL = 0.02, 0.05  # a joint that stands still is not where the reference is [rad], [rad/s]


class Phase(StrEnum):
    """What the supervisor lets happen."""

    INACTIVE = "inactive"  # waits for joint states that are good and at rest
    ACTIVE = "active"
    BRAKING = "braking"
    STOPPED = "stopped"  # until it is reset


class Supervisor:
    """Decides at every tick what the controller is asked for, and whether its reference is commanded.

    With ``led`` the reference only leads arms that another controller moves.
    """

    def __init__(
        self,
        robot: Robot,
        controller: CartesianController,
        streams: StreamSettings,
        watch: WatchSettings,
        origins: Origins | None = None,
        led: LedArms | None = None,
    ) -> None:
        self._controller, self._stream_settings, self._led = controller, streams, led
        self._origins = origins or Origins()
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._streams = {arm: TargetStream(streams) for arm in robot.arms}
        self._sequences = {arm: SequenceWatch() for arm in robot.arms}
        self._watch = JointWatch(robot.joint_names, robot.velocity_limit, watch, self._origins.joint_states)
        self._homing: Homing | None = None
        self._stopped: str | None = None  # why it takes a reset
        self._last: Reference | None = None
        self.phase = Phase.INACTIVE
        self.paused = False
        self.ceased: dict[str, str] = {}  # arms that hold since their targets ceased, with a line that says so
        self.events: list[str] = []  # what happened, for the log; taken by whoever writes it

    @property
    def fault(self) -> str | None:
        """Why nothing is commanded, or why the arms brake."""
        if self._stopped is None and self._watch.fault == NONE_YET:
            return NONE_YET + self._origins.joint_states()
        return self._stopped or self._watch.fault

    @property
    def homing(self) -> bool:
        return self._homing is not None

    @property
    def trusted(self) -> bool:
        """Whether the arms move, or hold, by joint states that are good."""
        return self.phase in (Phase.ACTIVE, Phase.BRAKING) and self._watch.fault is None

    def arm_state(self, arm: str) -> str:
        """What one arm does: following, homing or holding; or why no arm does anything."""
        if self.phase is not Phase.ACTIVE:
            return str(self.phase)
        if self.homing:
            return "homing"
        return "following" if self.follows(arm) else "holding"

    def follows(self, arm: str) -> bool:
        """Whether an arm follows its targets."""
        return self.phase is Phase.ACTIVE and self._streams[arm].following

    def target_age(self, arm: str, now: float) -> float:
        """Since the last target of an arm that was a pose [s]."""
        return now - self._streams[arm].stamp

    def take_joint_state(self, state: RobotState | str, now: float) -> None:
        """A joint state, or what is wrong with it."""
        before = self._watch.fault
        self._watch.take(state, now)
        if self.phase is Phase.INACTIVE and self._watch.fault not in (None, before):
            self.events.append(f"joint states: {self._watch.fault}")

    def take_target(self, arm: str, pose: pin.SE3 | None, now: float, number: int | None = None) -> Refusal | None:
        """A target in the world frame, or None for one that was no pose; returns why it is not followed, or None.

        ``number`` is the one among its publisher's messages, where the middleware tells.
        """
        stream = self._streams[arm]
        crowd = None if number is None else self._crowd(arm, number, now)
        refusal = None if pose is None else stream.offer(pose, self._controller.tool_pose(arm), now)
        if crowd is not None:
            stream.drop()
            return crowd
        if pose is None:
            return None
        if why := self._no_targets():
            stream.drop()
            return Refusal("stream", why)
        if refusal is None:
            self.ceased.pop(arm, None)
            return None
        return Refusal("stream", refusal)

    def _crowd(self, arm: str, number: int, now: float) -> Refusal | None:
        """Says so where not one publisher alone has sent an arm's targets lately."""
        breaks = self._sequences[arm].take(number, now, self._stream_settings.timeout)
        if breaks == 0:
            return None
        if breaks == 1:
            line = f"another publisher took over{self._origins.targets(arm)}; the targets have to begin anew"
            return Refusal("took over", line)
        return Refusal("publishers", f"two publishers at a time{self._origins.targets(arm)}; allowed: one")

    def _no_targets(self) -> str | None:
        if self.phase is not Phase.ACTIVE:
            return f"the controller is {self.phase}"
        if self.paused:
            return "the controller is paused"
        return "the arms are on their way home" if self.homing else None

    def tick(self, now: float, dt: float) -> Reference | None:
        """Move on by ``dt`` [s]; the reference to be commanded, or None."""
        if self.phase in (Phase.INACTIVE, Phase.STOPPED):
            if self.phase is Phase.INACTIVE and self._watch.settled(now):
                self._activate()
            return None
        if self.phase is Phase.ACTIVE:
            self._look(now)
        reference = self._step(self._targets(now, dt), dt)
        self._last = reference
        if self.phase is Phase.ACTIVE:
            self._compare(reference, now)
            self._look_home()
        elif float(np.abs(reference.v).max()) <= _REST:
            self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED
        return reference

    def _step(self, targets: dict[str, pin.SE3 | None], dt: float) -> Reference:
        state = self._watch.state
        if self._led is None or state is None or self.phase is not Phase.ACTIVE:
            return self._controller.step(targets, dt)
        reference = self._controller.step(self._led.targets(targets), dt, state.q)
        self._led.note(reference)
        return reference

    def _compare(self, reference: Reference, now: float) -> None:
        """Whether the arms are where the reference is. Those that are only led may have nobody who moves them."""
        away, state = self._watch.deviates(reference.q, now), self._watch.state
        if self._led is None or state is None:
            if away is not None:
                self.stop(away)
        elif too_close := self._led.too_close(state):
            self.stop(too_close)
        else:
            holding = [arm for arm, stream in self._streams.items() if not stream.following]
            if behind := away or self._led.left_behind(state, holding, now):
                self.start_over(behind, now)

    def pause(self, paused: bool) -> None:
        """Hold all arms where they come to rest, or allow new streams of targets."""
        self.paused = paused
        self._forget_targets()

    def stalled(self, duration: float, now: float) -> None:
        """The loop stood still for ``duration`` [s]: what it was about to command is of the past.

        The arms have come to rest by themselves meanwhile, so there is nothing to brake, and going on from the
        reference would be a jump. They are activated anew where they rest; targets that waited are no new stream.
        """
        if self.phase not in (Phase.ACTIVE, Phase.BRAKING):
            return
        fault = f"the control loop stood still for {duration:.2f} s"
        self._watch.take(fault, now)
        self._brake(fault)
        self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED

    @property
    def astray(self) -> bool:
        """Whether a joint stands still elsewhere than in the reference: maybe nobody moves it. One that lags moves."""
        state = self._watch.state
        if self.phase is not Phase.ACTIVE or self._last is None or state is None:
            return False
        return bool(((np.abs(state.q - self._last.q) > _ASTRAY) & (np.abs(state.v) < _STILL)).any())

    def abandon(self, fault: str, now: float) -> None:
        """Nobody takes the commands, or somebody else than before: whoever it is, the reference may have gone on.

        Then nothing more is commanded, not even the way to rest, which would be a jump to who comes.
        """
        if self.phase is Phase.ACTIVE:
            self.start_over(fault, now)
            self.phase = Phase.INACTIVE

    def start_over(self, fault: str, now: float) -> None:
        """Nobody goes where the reference goes: brake, and be activated anew where the arms are then.

        Whoever takes commands next is not to be asked for a reference that went on meanwhile.
        """
        if self.phase is Phase.ACTIVE:
            self._watch.take(fault, now)
            self._brake(fault)

    def stop(self, why: str) -> None:
        """Brake, and command nothing until :meth:`reset`."""
        self._stopped = why
        self._brake(why)
        if self.phase is Phase.INACTIVE:
            self.phase = Phase.STOPPED

    def reset(self) -> str | None:
        """Forget faults, stop, pause and all targets. Returns why that is not possible now, or None."""
        if self.phase is Phase.BRAKING:
            return "the arms are braking"
        self._stopped, self.paused = None, False
        self.ceased.clear()
        for stream in self._streams.values():
            stream.reset()
        self._homing = None
        if self.phase is Phase.STOPPED:
            self.phase = Phase.INACTIVE
        return None

    def go_home(self) -> str | None:
        """Begin the way home. Returns why that is not possible now, or None."""
        if self.phase is not Phase.ACTIVE or self.paused:
            return "the controller is paused" if self.paused else f"the controller is {self.phase}"
        self._forget_targets()
        self._homing = Homing(self._tools(), self._home)
        return None

    def _activate(self) -> None:
        state = self._watch.state
        assert state is not None
        self._controller.reset(state.q)
        self._forget_targets()
        if self._led is not None:
            self._led.begin()
        self._watch.accept()
        self._last = None
        self.phase = Phase.ACTIVE
        self.events.append("active: the reference starts at the measured posture")

    def _look(self, now: float) -> None:
        if fault := self._watch.check(now):
            self._brake(f"joint states: {fault}")

    def _brake(self, why: str) -> None:
        self._forget_targets()
        self.events.append(why)
        if self.phase is Phase.ACTIVE:
            self.phase = Phase.BRAKING

    def _forget_targets(self) -> None:
        self._homing = None
        for stream in self._streams.values():
            stream.drop()

    def _targets(self, now: float, dt: float) -> dict[str, pin.SE3 | None]:
        for arm, stream in self._streams.items():
            if stream.expire(now):
                self.ceased[arm] = f"{arm}: targets{self._origins.targets(arm)} have ceased, the arm holds"
                self.events.append(self.ceased[arm])
        if self._homing is not None:
            return self._homing.targets(dt)
        return {arm: stream.pose for arm, stream in self._streams.items()}

    def _look_home(self) -> None:
        if self._homing is not None and (outcome := self._homing.outcome(self._tools())):
            self._homing = None
            self.events.append(f"homing ended: {outcome}")

    def _tools(self) -> dict[str, pin.SE3]:
        return {arm: self._controller.tool_pose(arm) for arm in self._streams}
