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
from q2r2_control.ros.homing import Homing
from q2r2_control.ros.joint_watch import JointWatch, WatchSettings
from q2r2_control.ros.target_stream import StreamSettings, TargetStream
from q2r2_control.types import Reference, RobotState

_REST = 1e-4  # of the reference [rad/s]


class Phase(StrEnum):
    """What the supervisor lets happen."""

    INACTIVE = "inactive"  # waits for joint states that are good and at rest
    ACTIVE = "active"
    BRAKING = "braking"
    STOPPED = "stopped"  # until it is reset


class Supervisor:
    """Decides at every tick what the controller is asked for, and whether its reference is commanded."""

    def __init__(
        self, robot: Robot, controller: CartesianController, streams: StreamSettings, watch: WatchSettings
    ) -> None:
        self._robot, self._controller = robot, controller
        self._home = {arm: robot.tool_pose(robot.home, arm) for arm in robot.arms}
        self._streams = {arm: TargetStream(streams) for arm in robot.arms}
        self._watch = JointWatch(robot.joint_names, robot.velocity_limit, watch)
        self._homing: Homing | None = None
        self._stopped: str | None = None  # why it takes a reset
        self.phase = Phase.INACTIVE
        self.paused = False
        self.events: list[str] = []  # what happened, for the log; taken by whoever writes it

    @property
    def fault(self) -> str | None:
        """Why nothing is commanded, or why the arms brake."""
        return self._stopped or self._watch.fault

    @property
    def homing(self) -> bool:
        return self._homing is not None

    def arm_state(self, arm: str) -> str:
        """What one arm does: following, homing or holding; or why no arm does anything."""
        if self.phase is not Phase.ACTIVE:
            return str(self.phase)
        if self.homing:
            return "homing"
        return "following" if self._streams[arm].following else "holding"

    def target_age(self, arm: str, now: float) -> float:
        """Since the last target of an arm that was a pose [s]."""
        return now - self._streams[arm].stamp

    def take_joint_state(self, state: RobotState | str, now: float) -> None:
        """A joint state, or what is wrong with it."""
        before = self._watch.fault
        self._watch.take(state, now)
        if self.phase is Phase.INACTIVE and self._watch.fault not in (None, before):
            self.events.append(f"joint states: {self._watch.fault}")

    def take_target(self, arm: str, pose: pin.SE3, now: float) -> str | None:
        """A target in the world frame; returns why it is not followed, or None."""
        stream = self._streams[arm]
        refusal = stream.offer(pose, self._controller.tool_pose(arm), now)
        why = self._no_targets()
        if why is not None:
            stream.drop()
            return why
        return refusal

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
        reference = self._controller.step(self._targets(now, dt), dt)
        if self.phase is Phase.ACTIVE:
            if fault := self._watch.deviates(reference.q, now):
                self.stop(fault)
            self._look_home()
        elif float(np.abs(reference.v).max()) <= _REST:
            self.phase = Phase.INACTIVE if self._stopped is None else Phase.STOPPED
        return reference

    def pause(self, paused: bool) -> None:
        """Hold all arms where they come to rest, or allow new streams of targets."""
        self.paused = paused
        self._forget_targets()

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
        self._watch.accept()
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
                self.events.append(f"{arm}: targets have ceased, the arm holds")
        if self._homing is not None:
            return self._homing.targets(dt)
        return {arm: stream.pose for arm, stream in self._streams.items()}

    def _look_home(self) -> None:
        if self._homing is not None and (outcome := self._homing.outcome(self._tools())):
            self._homing = None
            self.events.append(f"homing ended: {outcome}")

    def _tools(self) -> dict[str, pin.SE3]:
        return {arm: self._controller.tool_pose(arm) for arm in self._streams}
