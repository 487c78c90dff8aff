"""Turn the ticks of the loop into commands for the sessions of all cabinets.

**The loop's time and the cabinets' time.** Each tick of the loop moves the reference to one period after the tick. If
recent ticks took longer, or commands came too late, the reference goes farther ahead by this delay. The cabinets get
each posture of the reference ``DELAY`` after the posture's time. If the loop is so late that the time of an answer
would be after the end of the reference, the cabinets get the certified stop. :meth:`FriCell.due` then lets the
reference follow the same stop first. If the time of an answer passes the end of the reference while a tick is computed,
the sessions refuse the command of this tick, and it is withdrawn.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.events import Reason
from q2r2_control.plants.fri.reasons import FriReason
from q2r2_control.plants.fri.session import DELAY
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import JOINTS, CommandKind, Monitoring, joints_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Command, CommandMode, RobotState

# Time that is allowed from the start of a tick until the sessions have its commands [s]. The first value is the usual
# time. After commands that came too late, the time grows up to the second value, and the reference goes farther ahead
# by the difference.
_MARGIN, _LONGEST_MARGIN = 0.002, 0.016
# Shortest step of the reference, as a share of the loop's period.
_SHORTEST = 0.5
_FORGETTING = 0.01  # Share by which the longest recent tick and the margin become shorter in each tick.
_PASSING = 0.0015  # Approximate time that a measurement takes through cabinet, network and processes [s].
_NO_COMMANDS = 0.1  # If no command has come in time for longer than this, this is reported as a fault [s].
# Time constant with which an arm loses its speed if no torque overlay comes: several periods of a cabinet [s].
_BRAKING_TIME = 0.03
_MISSING = 10  # If a cabinet's lost and unreadable messages reach this number in a run, they are reported.
_logger = logging.getLogger(__name__)


class FriCell:
    """The loop's side of all sessions: their states, and the commands for them."""

    def __init__(
        self,
        robot: Robot,
        states: Iterable[SessionState],
        period: float,
        longest: float,
        grippers: Mapping[str, GripperIoConfig] | None = None,
    ) -> None:
        """Make the loop's side.

        Args:
            robot: The robot.
            states: The state of each arm's session.
            period: Period of the loop [s].
            longest: The longest step of the reference [s]. The acceleration is constant during a step.
            grippers: The grippers of those arms that have one.
        """
        self.states = {state.arm: state for state in states}
        self._robot, self._period, self._longest, self._grippers = robot, period, longest, dict(grippers or {})
        self._joints = {arm: robot.arms[arm].joints for arm in self.states}
        self._data = robot.model.createData()
        # The time of the newest tick, and the start and end of the motion that it adds to the path [s].
        self._now = self._start = self._end = -math.inf
        # Whether the newest command is withdrawn, and the time of the last command that was not withdrawn [s].
        self._withdraws, self._in_time = False, -math.inf
        self._margin = _MARGIN  # Margin for the next command [s].
        self._longest_tick = period  # The longest recent tick [s].
        self._told = self._ends()  # How often each session had ended at the last call of :meth:`fault`, by arm.
        # Time of the first message of each arm whose losses were not reported yet [s].
        self._heard_since: dict[str, float] = {}

    def update(self, state: SessionState) -> None:
        """Take a newer state of an arm's session. Lost messages of its cabinet are reported once in a run."""
        if state.newest is not None and self.states[state.arm].newest is None:
            self._heard_since[state.arm] = state.arrival
            self._say_missing_output(state.arm, state.source, state.newest)
        self.states[state.arm] = state
        if state.arm in self._heard_since and state.lost + state.unreadable >= _MISSING:
            time = state.arrival - self._heard_since.pop(state.arm)
            missing = f"{state.lost} messages lost and {state.unreadable} unreadable in {time:.1f} s"
            _logger.warning("%s: %s: %s; q2r2 fri-check measures the network", state.arm, state.source, missing)

    def _say_missing_output(self, arm: str, source: str, newest: Monitoring) -> None:
        gripper = self._grippers.get(arm)
        if gripper is None or newest.output(gripper.output, False if gripper.digital else 0.0) is not None:
            return
        kind, names = "boolean" if gripper.digital else "analog", ", ".join(sorted(newest.outputs)) or "none"
        lacks = f"has no {kind} output {gripper.output}, so that the gripper is not commanded"
        _logger.warning("%s: %s %s; outputs that its application registers: %s", arm, source, lacks, names)

    def due(self, now: float) -> tuple[float, float]:
        """Return two durations for the tick at ``now`` [s]: the reference brakes first, and then moves [s].

        In the first duration, the reference follows the certified stop. This duration is 0 if no answer is for a time
        after the end of the path.
        """
        following = [state for state in self.states.values() if state.following]
        sent = now + self._margin
        latest = max([sent - DELAY, *(state.latest(sent) for state in following)])
        late, self._now, before = now - self._now if following else 0.0, now, self._end
        longest = max(late, (1.0 - _FORGETTING) * self._longest_tick)
        self._longest_tick = max(self._period, min(longest, self._longest))
        # Even if no arm follows, a session can have begun already without the loop's knowledge. Each tick therefore
        # moves the reference by one period.
        ahead = self._ahead if following else self._period
        if not following or latest <= before:
            braked, self._start = 0.0, before if following else now
        else:
            braked, self._start = latest - before, latest
        # The acceleration is constant during a step, because the path expects a parabola. If a tick is so late that the
        # step would be too long, the next tick adds the rest.
        step = min(max(now + ahead - self._start, _SHORTEST * self._period), self._longest)
        self._end = self._start + step
        return braked, step

    def apply(self, command: Command) -> dict[str, ArmCommand]:
        """Return the command for the session of each arm: the reference at the end of the tick of :meth:`due`."""
        sent = {}
        is_torque = command.mode is CommandMode.TORQUE
        if is_torque:
            model, data, measured = self._robot.model, self._data, self.state().q
            # Gravity is subtracted, because the cabinet itself bears it.
            overlay = command.tau - pin.computeGeneralizedGravity(model, data, measured)
            damping = pin.crba(model, data, measured).diagonal() / _BRAKING_TIME
        for arm, joints in self._joints.items():
            deceleration = command.deceleration
            # If the reference rests, the command has no deceleration. Any positive number can be used instead.
            stop = (1.0,) * JOINTS if deceleration is None else joints_of(deceleration[joints])
            q, v = joints_of(command.q[joints]), joints_of(command.v[joints])
            its = sent[arm] = ArmCommand(self._now, self._start, self._end, q, v, stop)
            gripper, opening = self._grippers.get(arm), command.grippers.get(arm)
            if gripper is not None and opening is not None:
                its.outputs = {gripper.output: opening >= 0.5 if gripper.digital else float(opening)}
            if is_torque:
                its.tau = None if command.gravity_only else joints_of(overlay[joints])
                its.damping = joints_of(damping[joints])
        return sent

    def fault(self) -> Reason | None:
        """Return why the arms cannot be commanded at the newest tick.

        If they can be commanded now, but could not at some time since the previous call of this method, return the
        reason for that. Otherwise, return None.
        """
        told, self._told = self._told, self._ends()
        for arm, state in self.states.items():
            dropped = self._told[arm] > told[arm]
            fault = state.fault(self._now) or (Reason.of(FriReason.FRI_DROPPED, arm=arm) if dropped else None)
            if fault is not None:
                return fault
        late = self._withdraws and self._now - self._in_time > _NO_COMMANDS
        return Reason(FriReason.FRI_OVERTAKEN) if late else None

    def _ends(self) -> dict[str, int]:
        return {arm: state.ended for arm, state in self.states.items()}

    def sent(self, taken: bool) -> None:
        """Record whether the sessions have ``taken`` the commands of a tick. If one came too late, they took none."""
        self._withdraws = not taken
        if taken:
            self._in_time, self._margin = self._now, max(_MARGIN, (1.0 - _FORGETTING) * self._margin)
        else:
            self._end, self._margin = self._start, min(2.0 * self._margin, _LONGEST_MARGIN)

    @property
    def _ahead(self) -> float:
        """The time from a tick to the end of the motion that it adds to the path [s].

        If no tick and no command is later than the recent ticks and commands, every answer is for a time before this
        end.
        """
        return self._longest_tick + self._margin - _MARGIN

    def withdraws(self) -> bool:
        """Return whether the newest command came too late. The arms then follow the stop of the command before it."""
        return self._withdraws

    def delay(self) -> float:
        """Return the time from the end of a command until a tick measures the arm at the command's posture [s].

        A cabinet begins to move the arm to this posture with its next message, and takes one period for this motion.
        The newest message is half a period old on average. With torques the result is 0, because torques act at once.
        """
        states = self.states.values()
        is_torque = any(state.wanted is CommandKind.TORQUE for state in states)
        farther = self._ahead - self._period
        return 0.0 if is_torque else farther + DELAY + _PASSING + 2.5 * max(state.period for state in states)

    def timings(self) -> dict[str, ArmTiming]:
        """Return the timing of all arms whose cabinets were heard.

        Answers with torques have no lag. For them, only the time since the cabinet's last message is of interest.
        """
        return {arm: state.timing(self._now) for arm, state in self.states.items() if state.newest is not None}

    def lead(self) -> float:
        """See :meth:`SessionPlant.lead`."""
        return DELAY + self._ahead + self._period

    def openings(self) -> dict[str, float]:
        """Return the measured opening of each gripper that has an input, from 0 for closed to 1 for open."""
        found = {}
        for arm, gripper in self._grippers.items():
            newest = self.states[arm].newest
            if newest is not None and gripper.input in newest.io:
                found[arm] = min(max(float(newest.io[gripper.input]), 0.0), 1.0)
        return found

    @property
    def is_heard(self) -> bool:
        """Whether every cabinet has sent a message."""
        return all(state.newest is not None for state in self.states.values())

    def state(self) -> RobotState:
        """Return the measurements in the cabinets' newest messages. The stamp is the earliest arrival of a message.

        If an arm can be commanded by positions, its held posture is the end of its path. The held posture of any other
        arm is its measured posture.
        """
        q, v, tau, external, held = np.zeros((5, self._robot.model.nv))
        knows_external = True
        for arm, state in self.states.items():
            joints, newest = self._joints[arm], state.newest
            assert newest is not None
            q[joints], v[joints] = newest.q, state.velocity
            tau[joints] = newest.tau or 0.0
            knows_external &= newest.external_tau is not None
            external[joints] = newest.external_tau or 0.0
            is_held = state.wanted is CommandKind.POSITION and state.fault(self._now) is None
            held[joints] = state.rest if is_held else newest.q
        stamp = min(state.arrival for state in self.states.values())
        return RobotState(q, v, tau, external if knows_external else None, stamp, held)
