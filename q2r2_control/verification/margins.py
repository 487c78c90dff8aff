"""The worst that was seen of everything a contract promises, and the first time that it was broken."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(slots=True)
class Margin:
    """One promise: ``worst`` has to stay at or below ``allowed`` (``sense`` "<=") or at or above it (">=")."""

    name: str
    unit: str
    sense: str
    allowed: float
    worst: float = field(init=False)
    tick: int | None = None  # of the worst
    checked: int = 0
    violations: int = 0

    def __post_init__(self) -> None:
        self.worst = -math.inf if self.sense == "<=" else math.inf

    def note(self, value: float, tick: int) -> bool:
        """Keep the worst; False where the promise is broken. What is not a number breaks it."""
        self.checked += 1
        if self.sense == "<=":
            worse, kept = not value <= self.worst, value <= self.allowed
        else:
            worse, kept = not value >= self.worst, value >= self.allowed
        if worse and not math.isnan(self.worst):
            self.worst, self.tick = value, tick
        self.violations += not kept
        return kept


def contract_margins() -> dict[str, Margin]:
    """What :class:`ContractWatch` checks, by short names."""
    rounding, coal = 1e-9, 2e-6  # [relative; rad]; [m], as exactly as Coal measures a capsule from a box
    rows = {
        "exceptions": ("exceptions raised by step", "", "<=", 0.0),
        "not_finite": ("references that are not finite", "", "<=", 0.0),
        "unreported": ("unusable targets not reported", "", "<=", 0.0),
        "refused": ("usable targets rejected", "", "<=", 0.0),
        "idle": ("motion in a dt that is no time", "rad", "<=", 0.0),
        "acceleration": ("acceleration / limit", "", "<=", 1.0 + rounding),
        "velocity": ("velocity / limit", "", "<=", 1.0 + rounding),
        "too_fast": ("started too fast: faster still", "rad/s", "<=", rounding),
        "position": ("room to position limits", "rad", ">=", -rounding),
        "outward": ("started outside limits: further out", "rad", "<=", rounding),
        "jump": ("way of a tick / way that v allows", "", "<=", 1.0 + rounding),
        "parabola": ("off constant acceleration or the stop", "rad", "<=", 1e-11),
        "distance": ("distance - min_distance, at ticks", "m", ">=", 0.0),
        "between": ("distance - min_distance, between ticks", "m", ">=", -coal),
        "stop": ("distance - min_distance, full stops", "m", ">=", -coal),
        "stop_position": ("room to position limits, full stops", "rad", ">=", -rounding),
        "truth": ("reported distance off Coal's", "m", "<=", coal),
        "bystanders": ("pairs apart while others recover", "m", ">=", -coal),
        "uncertified": ("certificates lost", "", "<=", 0.0),
        "approach": ("recovery: closer by, in a tick", "m", "<=", rounding),
        "not_stopped": ("solver failed: off the stop", "rad", "<=", 1e-11),
        "unsaid": ("solver failed: stop not reported", "", "<=", 0.0),
    }
    return {key: Margin(*row) for key, row in rows.items()}
