"""Collects the distances in one step of an environment, and why arms or grippers did less than was asked."""

from __future__ import annotations

import math
from typing import Any

from q2r2_control.summary.tick import Tick
from q2r2_control.wording import sentence


class StepPromises:
    """A listener of a run. Its caller calls :meth:`begin` at the start of each step of the environment."""

    def __init__(self) -> None:
        self._why: dict[str, str] = {}  # The reason of each arm's last event.
        # A line for each arm and gripper that did not carry out its action fully in this step, with the reason.
        self._held: dict[str, None] = {}
        self._limits: dict[str, dict[str, None]] = {}  # The joints or pairs that reached a limit, by kind of limit.
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
        """Return the entries that :class:`q2r2_control.gym.task_env.TaskEnv` describes."""
        limits = [f"{kind}: {', '.join(names)}" for kind, names in self._limits.items()]
        return {
            "nearest_distance": self._distance,
            "nearest_pair": self._pair,
            "margin": self._margin,
            "certified": self._certified,
            "held_back": "; ".join((*self._held, *limits)),
        }
