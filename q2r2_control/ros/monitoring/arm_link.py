"""The link between the nodes of the two arms: their stance, their heartbeats, and their faults."""

from __future__ import annotations

import math
import time
from typing import Any
from uuid import uuid4

from pydantic import BaseModel, ConfigDict, Field, ValidationError
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from std_msgs.msg import String

from q2r2_control.ros.base_node import LATCHED_QOS
from q2r2_control.types import SIDES

_PERIOD = 0.04  # of the heartbeat [s]


class _Heartbeat(BaseModel):
    """A heartbeat, sent as JSON in a String: which node sends it, and the last fault since that node was started."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    node: str
    id: str  # of this run of the node
    fault: int = Field(0, ge=0)  # number of the last fault; 0: there was none
    reason: str = ""
    age: float = Field(0.0, ge=0.0)  # of that fault [s]
    ended: bool = False
    stopped: bool = False  # both arms, by their operator
    change: int = Field(0, ge=0)  # number of the change that made it so


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

    Whether an operator has stopped both arms is one value for the pair, of which the change with the greater number
    counts; a stop, where two numbers are the same. So both nodes end with the same value whatever crosses on the way,
    and a node that is restarted learns it from the other one.

    No heartbeat for ``timeout`` [s] is a fault too, and so is a heartbeat of another run of the node where the first
    one has not announced its end. Time here is the machine's steady clock: a node may hang or die whatever simulated
    time does.
    """

    def __init__(self, node: Any, robot: str, arm: str, stance: str, timeout: float) -> None:
        self.other = SIDES[1 - SIDES.index(arm)]
        self._node, self._stance, self._timeout = node, stance, timeout
        self._own = _Heartbeat(node=node.get_fully_qualified_name(), id=uuid4().hex)
        self._faulted_at = self._engaged_at = -math.inf  # when this arm last was [s]
        self._other_stance: str | None = None
        self._newest: _Heartbeat | None = None  # of the other node; None: none yet, timed out, or ended in order
        self._received_at = -math.inf  # of the newest heartbeat [s]
        self._acted_on: tuple[str, int] = ("", 0)  # run of the node and number of its last fault
        self._told = ""  # the last fault of the other arm that was taken
        self._pending: str | None = None  # a fault of the other arm that was not taken yet
        self._stances = node.create_publisher(String, f"/{robot}/{arm}/stance", LATCHED_QOS)
        self._heartbeats = node.create_publisher(String, f"/{robot}/{arm}/link", 10)
        self._stance_of_other = f"/{robot}/{self.other}/stance"
        node.create_subscription(String, self._stance_of_other, self._on_stance, LATCHED_QOS)
        node.create_subscription(String, f"/{robot}/{self.other}/link", self._on_heartbeat, 10)
        node.create_timer(_PERIOD, self._send_heartbeat, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._stances.publish(String(data=stance))

    @property
    def disagreement(self) -> str | None:
        """One line if the two arms have different stances."""
        if self._node.count_publishers(self._stance_of_other) == 0:
            self._other_stance = None  # that node has ended; the next one publishes its own stance
        theirs = self._other_stance
        if theirs in (None, self._stance):
            return None
        return f"this arm is set to {self._stance}, the {self.other} one to {theirs}: set mirror alike in both"

    def engaged(self) -> None:
        """This arm is engaged from now on: earlier faults of the other arm do not pause it."""
        self._engaged_at = time.monotonic()

    def report(self, fault: str) -> None:
        """Tell the other arm to pause."""
        self._faulted_at = time.monotonic()
        self._own = self._own.model_copy(update={"fault": self._own.fault + 1, "reason": fault})
        self._send_heartbeat()

    @property
    def stopped(self) -> bool:
        """Whether both arms are stopped by their operator, as far as this node knows."""
        return self._own.stopped

    def set_stopped(self, stopped: bool) -> None:
        """This arm's operator stopped both arms, or took that back."""
        if stopped != self._own.stopped:
            self._own = self._own.model_copy(update={"stopped": stopped, "change": self._own.change + 1})
            self._send_heartbeat()

    def take_fault(self) -> str | None:
        """Why this arm has to pause because of the other one; each reason is returned once."""
        fault, self._pending = self._pending, None
        if fault is not None:
            self._told = f"linked to {self.other}: {fault}"
        silence = time.monotonic() - self._received_at
        if fault is None and self._newest is not None and silence > self._timeout:
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
        heartbeat = self._own.model_copy(update={"age": age, "ended": ended})
        self._heartbeats.publish(String(data=heartbeat.model_dump_json()))

    def _on_stance(self, message: String) -> None:
        self._other_stance = message.data

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
        if (theirs.change, theirs.stopped) > (self._own.change, self._own.stopped):
            self._own = self._own.model_copy(update={"stopped": theirs.stopped, "change": theirs.change})
        if theirs.ended:
            self._newest, self._pending = None, f"{theirs.node} has ended"
