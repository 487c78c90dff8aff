"""What the two arms' teleop nodes tell each other: their stance, that they live, and their faults."""

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

_PERIOD = 0.04  # of the sign of life [s]


class _Life(BaseModel):
    """A sign of life, as JSON in a String: who speaks, and the last fault of that node since it was started."""

    model_config = ConfigDict(frozen=True, allow_inf_nan=False)

    node: str
    id: str  # of this run of the node
    fault: int = Field(0, ge=0)  # number of the last fault; 0: there was none
    reason: str = ""
    age: float = Field(0.0, ge=0.0)  # of that fault [s]
    ended: bool = False


class ArmLink:
    """One arm's end of the link.

    The stance is latched at ``/<robot>/<arm>/stance``; ``/<robot>/<arm>/link`` carries a sign of life 25 times a
    second, and at once when there is a fault. An arm whose other node never came is alone and works alone.

    The rule: a fault of one arm pauses the other if that one has been engaged since before the fault, and once. So
    every sign of life repeats the last fault with its number and its age, for as long as the node runs:

    - No message matters by itself. Whichever comes first after the fault tells it, even if the arm that was at fault
      has been engaged again in between: the operator of the other one has seen nothing of it yet.
    - Nobody is paused by an old fault. A node that comes later, or an arm that was engaged after the fault, by a press
      that answers it, is younger than the fault: ages are durations, so that clocks of two machines need not agree.
      What a message takes on its way makes a fault look younger than it is, which errs towards pausing.
    - Nobody is paused twice by one fault. Its number is remembered with the run of the node that it belongs to, so
      that jitter of the ages does not matter, and a node that was started anew begins at 1 again.
    - A pause because of the other arm is no fault of this one and is not told back. Where both are at fault each
      tells its own, and either is engaged by its own press, whether the other one is or not.

    Silence for ``timeout`` [s] is a fault too, and so is another run of the node without a farewell in between.
    Time here is the machine's steady clock: a node may hang or die whatever simulated time does.
    """

    def __init__(self, node: Any, robot: str, arm: str, stance: str, timeout: float) -> None:
        self.other = SIDES[1 - SIDES.index(arm)]
        self._node, self._stance, self._timeout = node, stance, timeout
        self._own = _Life(node=node.get_fully_qualified_name(), id=uuid4().hex)
        self._faulted = self._engaged = -math.inf  # when this arm last was
        self._other_stance: str | None = None
        self._theirs: _Life | None = None  # the newest sign of life; None: none yet, silent, or ended in order
        self._heard = -math.inf
        self._acted_on: tuple[str, int] = ("", 0)  # run of the node and number of its last fault
        self._told: str | None = None
        self._stances = node.create_publisher(String, f"/{robot}/{arm}/stance", LATCHED_QOS)
        self._link = node.create_publisher(String, f"/{robot}/{arm}/link", 10)
        self._stance_of_other = f"/{robot}/{self.other}/stance"
        node.create_subscription(String, self._stance_of_other, self._on_stance, LATCHED_QOS)
        node.create_subscription(String, f"/{robot}/{self.other}/link", self._on_link, 10)
        node.create_timer(_PERIOD, self._live, clock=Clock(clock_type=ClockType.STEADY_TIME))
        self._stances.publish(String(data=stance))

    @property
    def disagreement(self) -> str | None:
        """What the two arms do not agree on, in one line."""
        if self._node.count_publishers(self._stance_of_other) == 0:
            self._other_stance = None  # what is gone has no say, and whoever comes next speaks for itself
        theirs = self._other_stance
        if theirs in (None, self._stance):
            return None
        return f"this arm is set to {self._stance}, the {self.other} one to {theirs}: set mirror alike in both"

    def engaged(self) -> None:
        """This arm is engaged from now on: what the other one tells of earlier times does not concern it."""
        self._engaged = time.monotonic()

    def report(self, fault: str) -> None:
        """Tell the other arm to pause."""
        self._faulted = time.monotonic()
        self._own = self._own.model_copy(update={"fault": self._own.fault + 1, "reason": fault})
        self._live()

    def take_fault(self) -> str | None:
        """Why this arm has to pause because of the other, once for each reason."""
        told, self._told = self._told, None
        silence = time.monotonic() - self._heard
        if told is None and self._theirs is not None and silence > self._timeout:
            told = f"{self._theirs.node} is silent for {silence:.2f} s"
            self._theirs = None
        return told and f"linked to {self.other}: {told}"

    def close(self) -> None:
        """Say that this end is closed in order."""
        self._live(ended=True)

    def _live(self, ended: bool = False) -> None:
        age = max(time.monotonic() - self._faulted, 0.0) if self._own.fault else 0.0
        self._link.publish(String(data=self._own.model_copy(update={"age": age, "ended": ended}).model_dump_json()))

    def _on_stance(self, message: String) -> None:
        self._other_stance = message.data

    def _on_link(self, message: String) -> None:
        try:
            theirs = _Life.model_validate_json(message.data)
        except ValidationError:
            return  # whoever says that is not the other arm's node, nor a sign of its life
        now, before = time.monotonic(), self._theirs
        self._theirs, self._heard = theirs, now
        if before is not None and before.id != theirs.id:
            self._told = f"{theirs.node} was started anew without a farewell, or runs twice"
        if theirs.fault and self._acted_on != (theirs.id, theirs.fault):
            self._acted_on = theirs.id, theirs.fault
            if now - theirs.age >= self._engaged:
                self._told = theirs.reason
        if theirs.ended:
            self._theirs, self._told = None, f"{theirs.node} was ended"
