"""The arms of a cell as their cabinets see them: one path of the reference, a session for each, in a time passed in.

**The loop's time and the cabinets'.** Each tick of the loop moves the reference to one period after the tick. The
cabinets are answered from it a little later (``DELAY``). Where the loop is so late that an answer may pass its end, the
certified stop is what the cabinets get. :meth:`FriCell.due` then lets the reference follow the same stop first. Where
an answer passed it although, in the middle of a tick, the command of that tick is withdrawn.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from threading import Lock

import numpy as np
import pinocchio as pin

from q2r2_control.config.fri import GripperIoConfig
from q2r2_control.events import Reason, ReasonKind
from q2r2_control.plants.fri.answers import ReferencePath
from q2r2_control.plants.fri.session import DELAY, ArmSession
from q2r2_control.plants.fri.wire import JOINTS, CommandKind, Monitoring
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Command, CommandMode, RobotState

# From the decision how far the reference goes until the path has it [s].
_MARGIN = 0.002
_NO_COMMANDS = 0.1  # so long without one that came in time is told [s]
# In which an arm loses most of its speed where no overlay comes: several periods of a cabinet [s].
_BRAKING_TIME = 0.03
# Of a reference that begins where its arm is held, or, with torques, where it is measured [rad].
_SAME, _NEAR = 1e-6, 0.02
_FROM_REST = 20.0  # more than a joint's acceleration in the first tick [rad/s^2]


class FriCell:
    """One thread answers, another one ticks; all but :meth:`answer` is the latter's."""

    def __init__(
        self,
        robot: Robot,
        sessions: Mapping[str, ArmSession],
        period: float,
        grippers: Mapping[str, GripperIoConfig] | None = None,
    ) -> None:
        """``period`` of the loop [s]; a session for each arm of the cell, and the grippers that some have."""
        self.sessions, self._robot, self._period = dict(sessions), robot, period
        self._grippers = dict(grippers or {})
        self._joints = {arm: robot.arms[arm].joints for arm in sessions}
        for arm, session in sessions.items():
            session.torque_limit = robot.torque_limit[self._joints[arm]]
        self._data = robot.model.createData()
        self._lock = Lock()
        self._now = self._start = self._end = -math.inf  # of the newest tick, and of its piece of the path [s]
        self._withdraws, self._in_time = False, -math.inf  # the newest command, and when one was not [s]

    def answer(self, arm: str, datagram: bytes, now: float) -> bytes | None:
        """The answer to a datagram from the cabinet of ``arm`` that came at ``now`` [s], if one is due."""
        with self._lock:
            return self.sessions[arm].answer(datagram, now)

    def due(self, now: float) -> tuple[float, float]:
        """In a tick at ``now`` [s]: how long the reference has to brake first, and to go on then [s]."""
        with self._lock:
            following = [session for session in self.sessions.values() if session.following]
            latest = max([now + _MARGIN - DELAY, *(session.answered for session in following)])
            self._now, before = now, self._end
            if not following or latest <= before:
                braked, self._start = 0.0, before if following else now
            else:
                braked, self._start = latest - before, latest
            # A step of one acceleration is a parabola, for the path too; of a late tick what is left comes in the next.
            step = min(max(now, self._start) + self._period - self._start, 2.0 * self._period)
            self._end = self._start + step
            return braked, step

    def apply(self, command: Command) -> None:
        """The reference at the end of the tick of :meth:`due`."""
        deceleration = command.deceleration
        overlay = None
        if command.mode is CommandMode.TORQUE:
            model, data, measured = self._robot.model, self._data, self.state().q
            overlay = command.tau - pin.computeGeneralizedGravity(model, data, measured)  # which the cabinet bears
            damping = pin.crba(model, data, measured).diagonal() / _BRAKING_TIME
        with self._lock:
            following = [session for session in self.sessions.values() if session.following]
            self._withdraws = any(session.answered > self._start for session in following)
            if self._withdraws:
                self._end = self._start
                return
            self._in_time = self._now
            for arm, session in self.sessions.items():
                joints = self._joints[arm]
                q, v = command.q[joints], command.v[joints]
                stop = np.ones(JOINTS) if deceleration is None else deceleration[joints]  # one at rest needs none
                if not session.following and self._begins(session, q, v):
                    session.following = session.fault(self._now) is None
                    session.path = ReferencePath(self._start, session.path.rest)
                if session.following and self._end > session.path.end:  # a second command in a tick is no motion
                    session.path.extend(self._end, q, v, stop, self._start)
                gripper, opening = self._grippers.get(arm), command.grippers.get(arm)
                if gripper is not None and opening is not None:
                    session.outputs = {gripper.output: opening >= 0.5 if gripper.digital else float(opening)}
                if overlay is not None:
                    session.tau, session.tau_came = overlay[joints], self._now
                    session.damping = damping[joints]

    def _begins(self, session: ArmSession, q: Array, v: Array) -> bool:
        """Whether a reference that is now at ``q``, and goes on at ``v``, was at rest a tick ago where the arm is."""
        torques, step = session.wanted is CommandKind.TORQUE and session.newest, self._end - self._start
        there, allowed = (np.array(torques.q), _NEAR) if torques else (session.path.rest, _SAME)
        way = np.abs(q - there)
        return bool((np.abs(v) <= _FROM_REST * step).all() and (way <= np.abs(v) * step + allowed).all())

    def fault(self) -> Reason | None:
        """Why the arms cannot be commanded at the newest tick, or ceased to be since the one before; None: they can."""
        with self._lock:
            found = None
            for arm, session in self.sessions.items():
                dropped, session.dropped = session.dropped, False
                fault = session.fault(self._now) or (Reason.of(ReasonKind.FRI_DROPPED, arm=arm) if dropped else None)
                found = found or fault
            late = self._withdraws and self._now - self._in_time > _NO_COMMANDS
            return found or (Reason(ReasonKind.FRI_OVERTAKEN) if late else None)

    def withdraws(self) -> bool:
        """Whether the newest command came after an answer that it was for: the arms go on along the stop before it."""
        return self._withdraws

    def delay(self) -> float:
        """From the end of a command until a tick finds the arm there [s].

        A cabinet begins to go there with its next message and takes a period for it. The newest message is half of one
        old in the mean. Torques count at once.
        """
        if any(session.wanted is CommandKind.TORQUE for session in self.sessions.values()):
            return 0.0
        return DELAY + 2.5 * max(session.period for session in self.sessions.values())

    def openings(self) -> dict[str, float]:
        """Measured opening of each gripper that has an input, 0 closed .. 1 open."""
        found = {}
        for arm, gripper in self._grippers.items():
            newest = self.sessions[arm].newest
            if newest is not None and gripper.input in newest.io:
                found[arm] = min(max(float(newest.io[gripper.input]), 0.0), 1.0)
        return found

    def newest(self, arm: str) -> tuple[Monitoring, float]:
        """The newest message of a cabinet that was heard, and when it came [s]."""
        with self._lock:
            session = self.sessions[arm]
            assert session.newest is not None
            return session.newest, session.arrival

    @property
    def is_heard(self) -> bool:
        """Whether every cabinet has said something."""
        return all(session.newest is not None for session in self.sessions.values())

    def state(self) -> RobotState:
        """Measurements of the cabinets, as old as the older message."""
        q, v, tau, external, held = np.zeros((5, self._robot.model.nv))
        knows_external = True
        with self._lock:
            for arm, session in self.sessions.items():
                joints, newest = self._joints[arm], session.newest
                assert newest is not None
                q[joints], v[joints] = newest.q, session.velocity
                tau[joints] = newest.tau or 0.0
                knows_external &= newest.external_tau is not None
                external[joints] = newest.external_tau or 0.0
                is_held = session.wanted is CommandKind.POSITION and session.fault(self._now) is None
                held[joints] = session.path.rest if is_held else newest.q
            stamp = min(session.arrival for session in self.sessions.values())
        return RobotState(q, v, tau, external if knows_external else None, stamp, held)
