"""Turn the ticks of the loop into commands for the sessions of all arms.

**The loop's time and the robots' time.** The robots' states count the time of the reference: with each state, this time
advances by 1 ms, and the robot gets the command for the next millisecond. Clocks do not matter. Each tick of the loop
extends the reference so far that no robot reaches the end of the reference before the next tick has come, unless the
next tick is later than usual. If the loop is so late that a robot reaches the end of the reference, the robots get the
certified stop. In the next tick, :meth:`FrankaCell.due` lets the reference follow the same stop first. If a robot
reaches the end while a tick is computed, the sessions refuse this tick's command, and the command is withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Iterable

import numpy as np
import pinocchio as pin

from q2r2_control import Command, CommandMode, Reason, Robot, RobotState
from q2r2_control.plants import ArmTiming
from q2r2_franka.limits import JOINTS, PERIOD
from q2r2_franka.reasons import FrankaReason
from q2r2_franka.state import ArmCommand, SessionState
from q2r2_franka.stream import SMOOTHING_DELAY

# Time that is allowed from the start of a tick until the sessions have its commands [s]. The first number is the usual
# time. After commands that came too late, the time is longer, but at most the second number. Each tick then extends the
# reference farther by the difference.
_MARGIN, _LONGEST_MARGIN = 0.002, 0.016
# Shortest step of the reference in a tick, as a share of a period. Steps are shorter than a period if the robots' time
# passes more slowly than the loop's time.
_SHORTEST = 0.1
_FORGETTING = 0.01  # Share by which the longest recent tick and the margin become shorter in each tick.
_NO_COMMANDS = 0.1  # If all commands have come too late for longer than this, a fault is reported [s].
_BRAKING_TIME = 0.03  # Time constant with which an arm loses its speed if no torques come [s].
_PASSING = 0.0015  # Approximate time that a measurement takes to pass through network and processes [s].


class FrankaCell:
    """The states of all sessions as the loop knows them. This class computes the commands from these states."""

    def __init__(self, robot: Robot, states: Iterable[SessionState], period: float, longest: float) -> None:
        """Take the first states of the sessions.

        Args:
            robot: The robot.
            states: The state of each arm's session.
            period: Period of the loop [s].
            longest: The longest step of the reference in one tick [s]. The acceleration is constant within a step.
        """
        self.states = {state.arm: state for state in states}
        self._robot, self._period, self._longest = robot, period, longest
        self._joints = {arm: robot.arms[arm].joints for arm in self.states}
        self._data = robot.model.createData()
        # The time of the newest tick by the loop's clock, and start and end of its step in the reference's time [s].
        self._now = self._start = self._end = -math.inf
        self._withdraws, self._in_time = False, -math.inf
        self._margin, self._longest_tick = _MARGIN, period
        self._told = self._ends()

    def update(self, state: SessionState) -> None:
        self.states[state.arm] = state

    def due(self, now: float) -> tuple[float, float]:
        """Return two durations of the reference's motion in the tick at ``now`` [s].

        During the first one, which may be 0, the reference follows the certified stop of an earlier tick. During the
        second one, it makes the motion of this tick.
        """
        following = [state for state in self.states.values() if state.following]
        late = now - self._now if following else 0.0
        self._now, before = now, self._end
        longest = max(late, (1.0 - _FORGETTING) * self._longest_tick)
        self._longest_tick = max(self._period, min(longest, self._longest))
        sent = now + self._margin
        if not following:
            braked, self._start = 0.0, sent
            step = self._period
        else:
            latest = max(state.latest(sent) for state in following)
            braked, self._start = max(latest - before, 0.0), max(latest, before)
            step = latest + self._longest_tick - self._start
        step = min(max(step, _SHORTEST * self._period), self._longest)
        self._end = self._start + step
        return braked, step

    def apply(self, command: Command) -> dict[str, ArmCommand]:
        """Return the command for each arm's session: the reference at the end of the newest tick's step."""
        sent = {}
        is_torque = command.mode is CommandMode.TORQUE
        if is_torque:
            model, data, measured = self._robot.model, self._data, self.state().q
            # Gravity is subtracted, because the robot adds it.
            overlay = command.tau - pin.computeGeneralizedGravity(model, data, measured)
            damping = pin.crba(model, data, measured).diagonal() / _BRAKING_TIME
        for arm, joints in self._joints.items():
            deceleration = command.deceleration
            # The deceleration is None if the reference is at rest. Then any positive number can be used.
            stop = (1.0,) * JOINTS if deceleration is None else tuple(deceleration[joints].tolist())
            q, v = tuple(command.q[joints].tolist()), tuple(command.v[joints].tolist())
            its = sent[arm] = ArmCommand(self._now, self._start, self._end, q, v, stop)
            if is_torque:
                its.tau = None if command.gravity_only else tuple(overlay[joints].tolist())
                its.damping = tuple(damping[joints].tolist())
        return sent

    def fault(self) -> Reason | None:
        """Return why the arms cannot be commanded now, or could not at some time since the previous call.

        Return None if they could be commanded during all of this time.
        """
        told, self._told = self._told, self._ends()
        for arm, state in self.states.items():
            fault = state.fault(self._now)
            if fault is None and self._told[arm] > told[arm]:
                text = state.problem or "no reason was given"
                fault = Reason.of(FrankaReason.FRANKA_ENDED, arm=arm, address=state.address, text=text)
            if fault is not None:
                return fault
        late = self._withdraws and self._now - self._in_time > _NO_COMMANDS
        return Reason(FrankaReason.FRANKA_OVERTAKEN) if late else None

    def _ends(self) -> dict[str, int]:
        return {arm: state.ended for arm, state in self.states.items()}

    def sent(self, taken: bool) -> None:
        """Store whether the sessions have ``taken`` a tick's commands. They refuse all if one command came too late."""
        self._withdraws = not taken
        if taken:
            self._in_time, self._margin = self._now, max(_MARGIN, (1.0 - _FORGETTING) * self._margin)
        else:
            self._end, self._margin = self._start, min(2.0 * self._margin, _LONGEST_MARGIN)

    def withdraws(self) -> bool:
        """Return whether the newest commands came too late. The arms then follow the stop of the previous commands."""
        return self._withdraws

    def delay(self) -> float:
        """Return the delay of measurements [s]; see :meth:`SessionPlant.delay`.

        It is 0 in torque mode, because torques act at once.
        """
        if any(state.wanted is CommandMode.TORQUE for state in self.states.values()):
            return 0.0
        return self.lead() + SMOOTHING_DELAY + _PASSING + PERIOD - self._period

    def lead(self) -> float:
        """See :meth:`SessionPlant.lead`."""
        return self._longest_tick + self._margin + PERIOD

    def timings(self) -> dict[str, ArmTiming]:
        """Return the timing of all arms whose robots have sent a state."""
        return {arm: state.timing(self._now) for arm, state in self.states.items() if state.newest is not None}

    @property
    def is_heard(self) -> bool:
        """Whether every robot has sent a state."""
        return all(state.newest is not None for state in self.states.values())

    def state(self) -> RobotState:
        """Return the measurements of the robots. Their stamp is the arrival time of the oldest state."""
        q, v, tau, external, held = np.zeros((5, self._robot.model.nv))
        for arm, state in self.states.items():
            joints, newest = self._joints[arm], state.newest
            assert newest is not None
            q[joints], v[joints], tau[joints], external[joints] = newest.q, newest.v, newest.tau, newest.external
            holds = state.wanted is CommandMode.POSITION and state.controlled
            held[joints] = state.rest if holds else newest.q
        stamp = min(state.arrival for state in self.states.values())
        return RobotState(q, v, tau, external, stamp, held)
