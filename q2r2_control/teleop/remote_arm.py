"""The other arm where another program drives it: what two programs agree on to carry, and the poses that they exchange.

    the program whose hand asked             the other one
    asks, in a new session            ->
                                      <-     agrees, holds its tool and says where; or refuses
    anchors both tools where they are
    the other tool's target           ->     which becomes its own, within its own bounds
                                      <-     where its controller has its tool

Each says its part again and again (:class:`CarryWord`), so a lost message does no harm, and either ends it by saying
something else. An agreement is between two runs of two programs: a program that was restarted is not meant by what was
said to the one before it.

A pose counts only in the session that both agree on, if it is newer than the last one, finite, and no jump from it. One
that does not count moves nothing; where none has counted for the timeout, the arms stop.
"""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.teleop import TeleopSettings
from q2r2_control.teleop.arm_states import ArmState, Cause, next_state
from q2r2_control.teleop.workspace import Workspace

# A jump that no arm makes between two messages [m], [rad].
_JUMP, _TURN = 0.05, 0.25
_REMEMBERED = 32  # poses of either arm, of which those of one moment are looked for


@dataclass(frozen=True, slots=True)
class CarryWord:
    """What a program says of carrying, until it says something else."""

    session: str  # named by the program that asks
    to: str  # the run of the program that is asked
    leads: bool = False  # of the program that asks, or carries
    tool: pin.SE3 | None = None  # of the one that agrees: where its tool is taken up, world frame
    refusal: str = ""  # why the arms do not carry, or not any more


class CarriedPose(NamedTuple):
    """Sent at each tick: the target of the tool that is carried, or where its controller has it."""

    session: str
    stamp: int  # of the sender's tick, by its clock [ns]
    pose: pin.SE3  # world frame
    reference: int | None = None  # of the controller's reference that the pose is of, by its clock [ns]


class RemoteArm:
    """The other arm, and its program. Times are seconds of this program's clock."""

    def __init__(self, arm: str, settings: TeleopSettings, run: str, timeout: float) -> None:
        """``run``: names this run of this program; ``timeout`` [s]: with an answer, and with a pose that counts."""
        self.arm = arm
        self.state = ArmState.IDLE
        self.run = run
        self.other_run: str | None = None  # of the other program; None: it is not there
        self.problem: str | None = None  # why the arms may not carry now, besides what they do
        self.heard: CarryWord | None = None  # what the other program says now
        self.said: CarryWord | None = None  # what this one says now
        self.reference: int | None = None  # of the controller's reference in this tick [ns]; None: there is none
        self.sends: pin.SE3 | None = None  # for the other program in this tick, world frame
        self.pose: pin.SE3 | None = None  # the last one that counted, world frame
        self._box, self._timeout = settings.workspace.get(arm), timeout  # type: ignore[call-overload]
        self._asks, self._answered = 0, ""
        self._since, self._stamp = -math.inf, -1
        self._refused = ""  # why the last pose did not count
        self._ours: deque[tuple[int, pin.SE3]] = deque(maxlen=_REMEMBERED)
        self._theirs: deque[tuple[int, pin.SE3]] = deque(maxlen=_REMEMBERED)

    def change(self, cause: Cause, now: float, reason: str) -> None:
        """See :meth:`ArmTeleop.change`; its own program tells of it."""
        self.state = next_state(self.state, cause)

    def workspace(self) -> Workspace:
        """The box of its targets."""
        return Workspace(self._box)

    @property
    def leads(self) -> bool:
        """Whether this program asks the other one, or leads it."""
        return self.said is not None and self.said.leads and not self.said.refusal

    @property
    def asked(self) -> bool:
        """Whether the other program asks, and has not been answered."""
        heard = self.heard
        if heard is None or heard.refusal or not heard.leads or heard.to != self.run:
            return False
        return heard.session != self._answered

    @property
    def agreed(self) -> bool:
        """Whether both say that they carry."""
        said, heard = self.said, self.heard
        if said is None or heard is None or said.refusal or heard.refusal:
            return False
        return said.session == heard.session

    @property
    def why_ended(self) -> str:
        """Why the other one does not agree any more."""
        said, heard = self.said, self.heard
        if said is not None and heard is not None and heard.session == said.session and heard.refusal:
            return heard.refusal
        return f"the {self.arm} arm's node has ended it"

    def ask(self, now: float) -> str | None:
        """Ask the other program; returns why that is not possible, or None."""
        if self.other_run is None:
            return f"the {self.arm} arm's node is not there"
        if self.problem is None and not self.leads:
            self._asks += 1
            self._since = now
            self.said = CarryWord(f"{self.run}.{self._asks}", self.other_run, leads=True)
        return self.problem

    def answer(self, now: float) -> pin.SE3 | str | None:
        """Where the other arm's tool is taken up, or why it is not; None: there is no answer yet."""
        if self.agreed and self.heard is not None and self.heard.tool is not None:
            return self.heard.tool
        if self.heard is not None and self.said is not None and self.heard.session == self.said.session:
            return self.heard.refusal or f"the {self.arm} arm's node does not say where its tool is"
        return f"the {self.arm} arm's node does not answer" if now - self._since > self._timeout else None

    def agree(self, tool: pin.SE3) -> None:
        """This arm is carried, and holds at ``tool``."""
        if self.heard is not None:
            self._answered = self.heard.session
            self.said = CarryWord(self.heard.session, self.run, tool=tool)

    def refuse(self, reason: str) -> None:
        """This arm is not carried."""
        if self.heard is not None:
            self._answered = self.heard.session
            self.said = CarryWord(self.heard.session, self.run, refusal=reason)

    def end(self, reason: str) -> None:
        """The arms do not carry any more, or are not asked to."""
        self.sends = None
        if self.said is not None and not self.said.refusal:
            self.said = replace(self.said, tool=None, refusal=reason)

    def begin(self, pose: pin.SE3, now: float) -> None:
        """Poses count from now on, the first of which is near ``pose``."""
        self.pose, self._since, self._stamp, self._refused = pose, now, -1, ""
        self._ours.clear()
        self._theirs.clear()

    def receive(self, sent: CarriedPose, now: float) -> None:
        """Take a pose if it counts."""
        if not self.agreed or self.said is None or sent.session != self.said.session or self.pose is None:
            return
        if (problem := self._fault(sent, self.pose)) is not None:
            self._refused = problem
            return
        self.pose, self._stamp, self._since = sent.pose, sent.stamp, now
        if sent.reference is not None:
            self._theirs.append((sent.reference, sent.pose))

    def silence(self, now: float) -> str | None:
        """One line if no pose has counted for too long."""
        if now - self._since <= self._timeout:
            return None
        last = f"; the last one {self._refused}" if self._refused else ""
        return f"no pose from the {self.arm} arm's node for {now - self._since:.2f} s{last}"

    def tools_at_once(self, arm: str, tool: pin.SE3 | None) -> dict[str, pin.SE3]:
        """Where the controller had both tools at one moment: the newest since the last call; empty: there is none.

        Poses that come over a network are of the past. Those of two moments would tell of a motion, not of a relation.
        ``tool``: where it has that of this ``arm`` now.
        """
        if tool is not None and self.reference is not None and (not self._ours or self._ours[-1][0] != self.reference):
            self._ours.append((self.reference, tool))
        theirs = dict(self._theirs)
        for moment, ours in reversed(self._ours):
            if moment in theirs:
                self._theirs = deque((one for one in self._theirs if one[0] > moment), maxlen=_REMEMBERED)
                return {arm: ours, self.arm: theirs[moment]}
        return {}

    def _fault(self, sent: CarriedPose, last: pin.SE3) -> str | None:
        """Why a pose does not count."""
        if not np.isfinite(sent.pose.homogeneous).all():
            return "was not finite"
        if sent.stamp <= self._stamp:
            return "was older than the one before it"
        distance = math.dist(sent.pose.translation, last.translation)
        if distance > _JUMP:
            return f"jumped {distance:.3f} m"
        angle = math.hypot(*pin.log3(last.rotation.T @ sent.pose.rotation))
        return f"jumped {angle:.2f} rad" if angle > _TURN else None
