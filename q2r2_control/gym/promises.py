"""The distances that the controller kept in one step of an environment, and why it held something back."""

from __future__ import annotations

import math
from typing import Any

from q2r2_control.summary.tick import Tick
from q2r2_control.wording import sentence


class StepPromises:
    """A listener of a run, whose steps :meth:`begin`."""

    def __init__(self) -> None:
        self._why: dict[str, str] = {}  # arm -> its last event
        self._held: dict[str, None] = {}  # arms and grippers in this step, in the order of time
        self._limits: dict[str, dict[str, None]] = {}  # of what kind -> joints or pairs
        self.begin()

    def begin(self) -> None:
        self._distance = self._margin = math.inf
        self._pair, self._certified = "", True
        self._held.clear()
        self._limits.clear()

    def __call__(self, tick: Tick) -> None:
        report = tick.reference.report
        if report.closest_distance < self._distance:
            self._distance, self._pair = report.closest_distance, ", ".join(report.closest_pair)
        self._margin = min(self._margin, report.margin)
        self._certified &= report.certified
        self._why |= {event.arm: sentence(event.reason) for event in tick.events}
        for arm in tick.states:
            if not tick.by_policy(arm):
                self._held[f"{arm} arm: {self._why.get(arm, tick.states[arm])}"] = None
        for arm, pair in tick.held_grippers.items():
            self._held[f"{arm} gripper: kept by {', '.join(pair)}"] = None
        for limit in report.binding:
            self._limits.setdefault(str(limit.kind), {})[" and ".join(limit.names)] = None

    def as_info(self) -> dict[str, Any]:
        """As :class:`q2r2_control.gym.task_env.TaskEnv` says."""
        limits = [f"{kind}: {', '.join(names)}" for kind, names in self._limits.items()]
        return {
            "nearest_distance": self._distance,
            "nearest_pair": self._pair,
            "margin": self._margin,
            "certified": self._certified,
            "held_back": "; ".join((*self._held, *limits)),
        }
