"""How the joints of a cell moved: what tests of faults measure from joint states and the times they were received."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from q2r2_control.types import Array
from tests.ros.waiting import eventually

SLOW = 0.05  # 3 % of a joint's limit; what is left is an arm that settles, not one that goes on [rad/s]
REST = 0.01  # [rad/s]
USUAL_GAP = 0.03  # between two joint states, on a machine that has the time [s]
LONGEST_STARVED = 0.1  # what a machine may be excused for; longer ones void the measurement [s]
RESTING = 0.3  # for this long [s]


class Joints(NamedTuple):
    """One joint state."""

    t: float  # of its receipt, on this machine's steady clock [s]
    q: Array
    v: Array


@dataclass(frozen=True)
class Stop:
    """How all joints came to rest after a fault."""

    fault: float  # when it was [s]
    speed: float  # of the fastest joint at the fault [rad/s]
    slow: float  # from the fault until all joints are slow for good [s]
    rest: float  # and until they rest [s]
    starved: float  # longest time without a joint state until then, above what is usual [s]
    posture: Array  # at rest
    t: float  # when they rest [s]


class JointLog:
    """Joint states in the order of ``names``, as they come."""

    def __init__(self, names: Sequence[str]) -> None:
        self.states: list[Joints] = []
        self._names = list(names)

    def take(self, names: Sequence[str], q: Sequence[float], v: Sequence[float], t: float) -> None:
        """Append one; joints of others may be in it."""
        place = {name: index for index, name in enumerate(names)}
        order = [place[name] for name in self._names]
        self.states.append(Joints(t, np.array(q)[order], np.array(v)[order]))

    @property
    def q(self) -> Array:
        """The newest positions [rad]."""
        return self.states[-1].q

    def since(self, t: float) -> list[Joints]:
        """All states received after ``t`` [s]."""
        states = self.states[:]  # another thread appends
        first = len(states)
        while first and states[first - 1].t > t:
            first -= 1
        return states[first:]

    def speeds(self, duration: float) -> Array:
        """Greatest speed of each joint in the last ``duration`` [s]."""
        recent = self.since(time.monotonic() - duration)
        return np.max([np.abs(state.v) for state in recent], axis=0) if recent else np.zeros(len(self._names))

    def stop_after(self, fault: float) -> Stop:
        """Wait until all joints rest after a fault at ``fault`` [s]."""

        def last(speed: float) -> float:
            """When any joint was last faster than that [s]."""
            return max((state.t for state in self.since(fault) if np.abs(state.v).max() > speed), default=fault)

        eventually(lambda: self.states[-1].t - last(REST) > RESTING, "all joints rest")
        before = [state for state in self.states if state.t <= fault][-1]
        slow, rest = (self.since(last(speed))[0].t for speed in (SLOW, REST))
        gaps = np.diff([before.t, *(state.t for state in self.since(fault) if state.t <= rest)])
        starved = max(float(gaps.max()) - USUAL_GAP, 0.0)
        return Stop(fault, float(np.abs(before.v).max()), slow - fault, rest - fault, starved, self.q, rest)

    def farthest_from(self, posture: Array, since: float, until: float = math.inf) -> float:
        """How far any joint has been from ``posture`` [rad]."""
        return max(float(np.abs(state.q - posture).max()) for state in self.since(since) if state.t <= until)
