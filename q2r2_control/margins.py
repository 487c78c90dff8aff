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
    rounding, coal = 1e-9, 1e-8  # [relative; rad], [m]: Coal's own accuracy
    rows = {
        "exceptions": ("exceptions raised by step", "", "<=", 0.0),
        "not_finite": ("references with numbers that are not finite", "", "<=", 0.0),
        "unreported": ("unusable targets not reported", "", "<=", 0.0),
        "refused": ("usable targets reported as rejected", "", "<=", 0.0),
        "idle": ("motion in a dt that is no time", "rad", "<=", 0.0),
        "acceleration": ("acceleration / limit", "", "<=", 1.0 + rounding),
        "velocity": ("velocity / limit", "", "<=", 1.0 + rounding),
        "too_fast": ("started above the velocity limit: faster still", "rad/s", "<=", rounding),
        "position": ("room to position limits less margin", "rad", ">=", -rounding),
        "outward": ("started outside position limits: outward, not braking", "rad", "<=", rounding),
        "jump": ("way of a tick / way that the velocities allow", "", "<=", 1.0 + rounding),
        "parabola": ("reference off constant acceleration or stop", "rad", "<=", 1e-11),
        "distance": ("least distance less min_distance, at ticks", "m", ">=", 0.0),
        "between": ("least distance less min_distance, between ticks", "m", ">=", -coal),
        "stop": ("least distance less min_distance, during full stops", "m", ">=", -coal),
        "stop_position": ("room to position limits where a full stop ends", "rad", ">=", -rounding),
        "truth": ("reported least distance off Coal's", "m", "<=", coal),
        "bystanders": ("pairs apart less min_distance, others recovering", "m", ">=", -coal),
        "uncertified": ("ticks without a certificate that was known before", "", "<=", 0.0),
        "approach": ("started in penetration: coming closer in a tick", "m", "<=", rounding),
        "not_stopped": ("solver failed: off the certified stop", "rad, rad/s", "<=", 1e-11),
        "unsaid": ("solver failed: stop not reported", "", "<=", 0.0),
    }
    return {key: Margin(*row) for key, row in rows.items()}
