"""The arms of a cell as their cabinets see them: from ticks of the loop to commands for all sessions.

**The loop's time and the cabinets'.** Each tick of the loop moves the reference to one period after the tick. Where
ticks took longer lately, or their commands came too late, it goes farther ahead by as much. The cabinets are answered
from it a little later (``DELAY``). Where the loop is so late that an answer may pass its end, the certified stop is
what the cabinets get. :meth:`FriCell.due` then lets the reference follow the same stop first. Where an answer has
passed it in the middle of a tick, the sessions refuse the command of that tick, and it is withdrawn.
"""

from __future__ import annotations

import logging
import math
from collections.abc import Iterable, Mapping

import numpy as np
import pinocchio as pin

from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.plants.fri.session import DELAY
from q2r2_control.plants.fri.session_state import ArmCommand, SessionState
from q2r2_control.plants.fri.wire import JOINTS, CommandKind, Monitoring, joints_of
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ArmTiming, Command, CommandMode, RobotState

# From the decision how far the reference goes until the sessions have it, and after commands that came too late [s].
# The reference then goes farther ahead by the difference.
_MARGIN, _LONGEST_MARGIN = 0.002, 0.016
# Of a period, the shortest step of the reference.
_SHORTEST = 0.5
_FORGETTING = 0.01  # share of the longest tick and margin lately that each tick forgets
_PASSING = 0.0015  # from a measurement until it has passed cabinet, network and processes, about [s]
_NO_COMMANDS = 0.1  # so long without one that came in time is told [s]
# In which an arm loses most of its speed where no overlay comes: several periods of a cabinet [s].
_BRAKING_TIME = 0.03
_MISSING = 10  # messages of a cabinet in a run; fewer are chance, and more are said
_logger = logging.getLogger(__name__)


class FriCell:
    """The loop's side: what the sessions are like, and what they are sent."""

    def __init__(
        self,
        robot: Robot,
        states: Iterable[SessionState],
        period: float,
        longest: float,
        grippers: Mapping[str, GripperIoConfig] | None = None,
    ) -> None:
        """``period`` of the loop, and the ``longest`` step of its reference [s], which has one acceleration.

        The state of each arm's session, and the grippers that some arms have.
        """
        self.states = {state.arm: state for state in states}
        self._robot, self._period, self._longest, self._grippers = robot, period, longest, dict(grippers or {})
        self._joints = {arm: robot.arms[arm].joints for arm in self.states}
        self._data = robot.model.createData()
        self._now = self._start = self._end = -math.inf  # of the newest tick, and of its piece of the path [s]
        self._withdraws, self._in_time = False, -math.inf  # the newest command, and when one was not [s]
        self._margin = _MARGIN  # for the next command [s]
        self._longest_tick = period  # lately [s]
        self._told = self._ends()
        self._heard_since: dict[str, float] = {}  # arms' first messages [s]; not of those whose losses were said

    def update(self, state: SessionState) -> None:
        """A newer state of an arm's session. One warning a run says that messages of its cabinet are missing."""
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
        """In a tick at ``now`` [s]: how long the reference has to brake first, and to go on then [s]."""
        following = [state for state in self.states.values() if state.following]
        sent = now + self._margin
        latest = max([sent - DELAY, *(state.latest(sent) for state in following)])
        late, self._now, before = now - self._now if following else 0.0, now, self._end
        longest = max(late, (1.0 - _FORGETTING) * self._longest_tick)
        self._longest_tick = max(self._period, min(longest, self._longest))
        # A session that has just begun may not be known yet: the path gets a step for each period then.
        ahead = self._ahead if following else self._period
        if not following or latest <= before:
            braked, self._start = 0.0, before if following else now
        else:
            braked, self._start = latest - before, latest
        # A step of one acceleration is a parabola, for the path too; of a late tick what is left comes in the next.
        step = min(max(now + ahead - self._start, _SHORTEST * self._period), self._longest)
        self._end = self._start + step
        return braked, step

    def apply(self, command: Command) -> dict[str, ArmCommand]:
        """For each arm what its session is to be sent: the reference at the end of the tick of :meth:`due`."""
        sent = {}
        is_torque = command.mode is CommandMode.TORQUE
        if is_torque:
            model, data, measured = self._robot.model, self._data, self.state().q
            overlay = command.tau - pin.computeGeneralizedGravity(model, data, measured)  # which the cabinet bears
            damping = pin.crba(model, data, measured).diagonal() / _BRAKING_TIME
        for arm, joints in self._joints.items():
            deceleration = command.deceleration
            # A reference at rest comes without a stop.
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
        """Why the arms cannot be commanded at the newest tick, or ceased to be since the last call; None: they can."""
        told, self._told = self._told, self._ends()
        for arm, state in self.states.items():
            dropped = self._told[arm] > told[arm]
            fault = state.fault(self._now) or (Reason.of(ReasonKind.FRI_DROPPED, arm=arm) if dropped else None)
            if fault is not None:
                return fault
        late = self._withdraws and self._now - self._in_time > _NO_COMMANDS
        return Reason(ReasonKind.FRI_OVERTAKEN) if late else None

    def _ends(self) -> dict[str, int]:
        return {arm: state.ended for arm, state in self.states.items()}

    def sent(self, taken: bool) -> None:
        """The commands of a tick were ``taken`` by the sessions, or came too late for one of them."""
        self._withdraws = not taken
        if taken:
            self._in_time, self._margin = self._now, max(_MARGIN, (1.0 - _FORGETTING) * self._margin)
        else:
            self._end, self._margin = self._start, min(2.0 * self._margin, _LONGEST_MARGIN)

    @property
    def _ahead(self) -> float:
        """From a tick to the end of its piece of the path [s].

        No answer passes it before the next command has come, if neither is later than one was lately.
        """
        return self._longest_tick + self._margin - _MARGIN

    def withdraws(self) -> bool:
        """Whether the newest command came after an answer that it was for: the arms go on along the stop before it."""
        return self._withdraws

    def delay(self) -> float:
        """From the end of a command until a tick finds the arm there [s].

        A cabinet begins to go there with its next message and takes a period for it. The newest message is half of one
        old in the mean. Torques count at once.
        """
        states = self.states.values()
        is_torque = any(state.wanted is CommandKind.TORQUE for state in states)
        farther = self._ahead - self._period
        return 0.0 if is_torque else farther + DELAY + _PASSING + 2.5 * max(state.period for state in states)

    def timings(self) -> dict[str, ArmTiming]:
        """Of all arms that were heard, at the newest tick. Torques are for no time: there only silence tells."""
        return {arm: state.timing(self._now) for arm, state in self.states.items() if state.newest is not None}

    def lead(self) -> float:
        """See :meth:`SessionPlant.lead`."""
        return DELAY + self._ahead + self._period

    def openings(self) -> dict[str, float]:
        """Measured opening of each gripper that has an input, 0 closed .. 1 open."""
        found = {}
        for arm, gripper in self._grippers.items():
            newest = self.states[arm].newest
            if newest is not None and gripper.input in newest.io:
                found[arm] = min(max(float(newest.io[gripper.input]), 0.0), 1.0)
        return found

    @property
    def is_heard(self) -> bool:
        """Whether every cabinet has said something."""
        return all(state.newest is not None for state in self.states.values())

    def state(self) -> RobotState:
        """Measurements of the cabinets, as old as the older message."""
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
