"""The link between the nodes of the two arms: their stance, their heartbeats, and their faults."""

from __future__ import annotations

import math
import time
from typing import Annotated, Any
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_msgs.msg import String

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.ros.monitoring.endpoints import PublisherCount
from q2r2_control.teleop.both_arms import PAUSE_FIRST
from q2r2_control.types import SIDES

_PERIOD = 0.04  # of the heartbeat [s]
PoseNumbers = Annotated[tuple[float, ...], Field(min_length=7, max_length=7)]  # position and quaternion x y z w


class _Shared(BaseModel):
    """A value that both nodes have in common."""

    model_config = ConfigDict(frozen=True)

    change: int = Field(0, ge=0)  # number of the change that made it so
    value: bool = False

    def changed(self, value: bool) -> _Shared:
        return self if value == self.value else _Shared(change=self.change + 1, value=value)

    def newer(self, other: _Shared) -> _Shared:
        return max(self, other, key=lambda one: (one.change, one.value))


class CarryTold(BaseModel):
    """What a node says of carrying, see :class:`CarryWord`; ``tool`` is in ``frame``."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    session: str
    to: str
    leads: bool = False
    frame: str = ""
    tool: PoseNumbers | None = None
    refusal: str = ""


class _Heartbeat(BaseModel):
    """A heartbeat, sent as JSON in a String: which node sends it, and the last fault since that node was started."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    node: str
    id: str  # of this run of the node
    fault: int = Field(0, ge=0)  # number of the last fault; 0: there was none
    reason: str = ""
    of_frame: bool = False  # that fault is of the frame that both hands are measured in
    aligning: bool = False  # the hand may move that frame now
    age: float = Field(0.0, ge=0.0)  # of that fault [s]
    ended: bool = False
    stopped: _Shared = _Shared()  # both arms, by their operator
    swapped: _Shared = _Shared()  # each hand drives the other arm
    at_rest: bool = False  # this arm neither follows nor moves nor is stopped
    carry: CarryTold | None = None


class ArmLink:
    """One arm's end of the link.

    The stance is latched at ``/<robot>/<arm>/stance``. ``/<robot>/<arm>/link`` carries a heartbeat 25 times a second,
    and one at once when there is a fault. If the other arm's node never appears, this arm works alone.

    The rule: a fault of one arm pauses the other arm once, if that arm has been engaged since before the fault. So
    every heartbeat repeats the last fault with its number and its age, for as long as the node runs:

    - A lost message does no harm. The next one reports the same fault, even if the arm at fault has been engaged again
      in between: the operator of the other arm has not seen the fault yet.
    - An old fault pauses no arm. A node that starts after the fault, or an arm that is engaged after it, ignores it.
      Ages are durations, so the clocks of two machines need not agree. The delay of a message makes a fault look
      younger than it is, which can only cause a pause too many, never one too few.
    - One fault pauses an arm only once. Its number is remembered together with the run of the node that it belongs to,
      so jitter of the ages does not matter, and a node that is restarted counts from 1 again.
    - A pause because of a fault that the other arm has sent is not sent back. Where both arms are at fault each sends
      its own, and each is engaged by its own press, whether the other one is engaged or not.
    - Silence of the other arm is a fault that this arm has found, and is sent: a node that was stopped for less than
      its own timeout goes on as if nothing had happened, and its arm would move alone.

    An alignment by this arm's hand is reported like a fault, whatever state this arm is in, since it moves the frame
    that the other hand is measured in too. It counts for arms that are not linked as well, and while it lasts the other
    arm is not to be engaged.

    Whether an operator has stopped both arms is one value for the pair, of which the change with the greater number
    counts; a stop, where two numbers are the same. So both nodes end with the same value whatever crosses on the way,
    and a node that is restarted learns it from the other one. So is whether the hands are swapped. An arm is not to be
    engaged while the nodes differ in that: until the other one has let go of a hand, that hand still drives its arm.

    What either says of carrying is its own, and stands until it says something else.

    No heartbeat for ``timeout`` [s] is a fault too, and so is a heartbeat of another run of the node where the first
    one has not announced its end. Time here is the machine's steady clock: a node may hang or die whatever simulated
    time does.
    """

    def __init__(self, node: Any, robot: str, arm: str, stance: str, timeout: float) -> None:
        self.other = SIDES[1 - SIDES.index(arm)]
        self._node, self._stance, self._timeout = node, stance, timeout
        self._own = _Heartbeat(node=node.get_fully_qualified_name(), id=uuid4().hex)
        self.at_rest = False  # whether this arm may be engaged, or given to another hand
        self._faulted_at = self._engaged_at = -math.inf  # when this arm last was [s]
        self._other_stance: str | None = None
        self._newest: _Heartbeat | None = None  # of the other node; None: none yet, timed out, or ended in order
        self._received_at = -math.inf  # of the newest heartbeat [s]
        self._acted_on: tuple[str, int] = ("", 0)  # run of the node and number of its last fault
        self._told = ""  # the last fault of the other arm that was taken
        self._pending: str | None = None  # a fault of the other arm that was not taken yet
        self._pending_of_frame = False
        self._robot = robot
        self._stances = node.create_publisher(String, self.topic_of(arm, "stance"), LATCHED_QOS)
        self._heartbeats = node.create_publisher(String, self.topic_of(arm, "link"), 10)
        stance_of_other = self.topic_of(self.other, "stance")
        self._stances_of_other = PublisherCount(node, stance_of_other)
        node.create_subscription(String, stance_of_other, self._on_stance, LATCHED_QOS)
        node.create_subscription(String, self.topic_of(self.other, "link"), self._on_heartbeat, 10)
        node.create_timer(_PERIOD, self._send_heartbeat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._stances.publish(String(data=stance))

    def topic_of(self, arm: str, what: str) -> str:
        """The topic on which an arm's node says ``what`` is for the pair."""
        return f"/{self._robot}/{arm}/{what}"

    @property
    def disagreement(self) -> str | None:
        """One line if the two arms have different stances."""
        if self._stances_of_other.count == 0:
            self._other_stance = None  # that node has ended; the next one publishes its own stance
        theirs = self._other_stance
        if theirs in (None, self._stance):
            return None
        return f"this arm is set to {self._stance}, the {self.other} one to {theirs}: set mirror alike in both"

    def set_stance(self, stance: str) -> None:
        """This arm's stance is another one from now on."""
        if stance != self._stance:
            self._stance = stance
            self._stances.publish(String(data=stance))

    @property
    def turning_refused(self) -> str | None:
        """Why this arm's stance may not change now, besides this arm's state, or None."""
        return None if self._newest is None or self._newest.at_rest else PAUSE_FIRST

    def engaged(self) -> None:
        """This arm is engaged from now on: earlier faults of the other arm do not pause it."""
        self._engaged_at = time.monotonic()

    def report(self, fault: str, of_frame: bool = False) -> None:
        """Tell the other arm to pause; ``of_frame``: also where the arms are not linked."""
        self._faulted_at = time.monotonic()
        changes = {"fault": self._own.fault + 1, "reason": fault, "of_frame": of_frame}
        self._own = self._own.model_copy(update=changes)
        self._send_heartbeat()

    def set_aligning(self, aligning: bool) -> None:
        """Whether this arm's hand aligns the frame now."""
        if aligning == self._own.aligning:
            return
        self._own = self._own.model_copy(update={"aligning": aligning})
        if aligning:
            self.report("alignment chord", of_frame=True)
        else:
            self._send_heartbeat()

    @property
    def aligning(self) -> str | None:
        """One line while the other arm's hand aligns the frame."""
        aligning = self._newest is not None and self._newest.aligning
        return f"the {self.other} arm's hand aligns the frame" if aligning else None

    @property
    def stopped(self) -> bool:
        """Whether both arms are stopped by their operator, as far as this node knows."""
        return self._own.stopped.value

    def set_stopped(self, stopped: bool) -> None:
        """This arm's operator stopped both arms, or took that back."""
        self._share("stopped", self._own.stopped.changed(stopped))

    @property
    def swapped(self) -> bool:
        """Whether each hand drives the other arm, as far as this node knows."""
        return self._own.swapped.value

    def set_swapped(self, swapped: bool) -> None:
        """This arm's hand swapped the hands, or swapped them back."""
        self._share("swapped", self._own.swapped.changed(swapped))

    @property
    def swapping(self) -> str | None:
        """One line while the other node has not swapped hands as this one has."""
        if self._newest is None or self._newest.swapped == self._own.swapped:
            return None
        return f"{self._newest.node} has not swapped hands yet"

    @property
    def unswappable(self) -> str | None:
        """Why the hands cannot be swapped now, besides this arm's state, or None."""
        if self._newest is None:
            return f"the {self.other} arm's node is not there"
        return self.swapping or (None if self._newest.at_rest else PAUSE_FIRST)

    @property
    def run(self) -> str:
        """Names this run of this node."""
        return self._own.id

    @property
    def other_run(self) -> str | None:
        """The same of the other node; None: it is not there."""
        return None if self._newest is None else self._newest.id

    @property
    def carry(self) -> CarryTold | None:
        """What the other node says of carrying now."""
        return None if self._newest is None else self._newest.carry

    def say_carry(self, told: CarryTold | None) -> None:
        """What this node says of carrying from now on."""
        self._share("carry", told)

    def take_fault(self, linked: bool = True) -> str | None:
        """Why this arm has to pause because of the other one; each reason is returned once.

        Of arms that are not ``linked`` only what is of the frame of both hands counts.
        """
        fault, self._pending = self._pending, None
        of_frame, self._pending_of_frame = self._pending_of_frame, False
        if not (linked or of_frame):
            return None
        if fault is not None:
            self._told = f"linked to {self.other}: {fault}"
        silence = time.monotonic() - self._received_at
        if linked and fault is None and self._newest is not None and silence > self._timeout:
            fault = f"{self._newest.node} is silent for {silence:.2f} s"
            self._newest = None
        return fault and f"linked to {self.other}: {fault}"

    def told(self, reason: str) -> bool:
        """Whether ``reason`` is the last fault that the other arm has told, and knows."""
        return reason == self._told

    def close(self) -> None:
        """Announce the end of this node, so that the other one does not wait for its heartbeat."""
        self._send_heartbeat(ended=True)

    def _send_heartbeat(self, ended: bool = False) -> None:
        age = max(time.monotonic() - self._faulted_at, 0.0) if self._own.fault else 0.0
        heartbeat = self._own.model_copy(update={"age": age, "ended": ended, "at_rest": self.at_rest})
        self._heartbeats.publish(String(data=heartbeat.model_dump_json()))

    def _share(self, name: str, value: _Shared | CarryTold | None) -> None:
        if value != getattr(self._own, name):
            self._own = self._own.model_copy(update={name: value})
            self._send_heartbeat()

    def _on_stance(self, message: String) -> None:
        self._other_stance = message.data
        self._stances_of_other.ask_anew()  # it is latched and comes once: an older count must not take it back

    def _on_heartbeat(self, message: String) -> None:
        try:
            theirs = _Heartbeat.model_validate_json(message.data)
        except ValidationError:
            return  # not from an arm's node
        now, before = time.monotonic(), self._newest
        self._newest, self._received_at = theirs, now
        if before is not None and before.id != theirs.id:
            self._pending = f"{theirs.node} was restarted without announcing its end, or runs twice"
        if theirs.fault and self._acted_on != (theirs.id, theirs.fault):
            self._acted_on = theirs.id, theirs.fault
            if now - theirs.age >= self._engaged_at:
                self._pending = theirs.reason
                self._pending_of_frame |= theirs.of_frame
        self._share("stopped", self._own.stopped.newer(theirs.stopped))
        self._share("swapped", self._own.swapped.newer(theirs.swapped))
        if theirs.ended:
            self._newest, self._pending = None, f"{theirs.node} has ended"
