"""The promises of the Cartesian controller, and the worst value that was seen of each."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from q2r2_control.control.safety.safety_data import ROUNDING

RELATIVE = 1e-9  # to which the contract promises limits
COAL = 2e-6  # how exactly Coal measures a capsule from a box [m]

PROMISES = {  # key: name, unit, and what its value has to be
    "exceptions": ("exceptions raised by step", "", "<=", 0.0),
    "not_finite": ("references that are not finite", "", "<=", 0.0),
    "unreported": ("unusable targets not reported", "", "<=", 0.0),
    "refused": ("usable targets rejected", "", "<=", 0.0),
    "idle": ("motion in a dt that is no time", "rad", "<=", 0.0),
    "acceleration": ("acceleration / limit", "", "<=", 1.0 + RELATIVE),
    "velocity": ("velocity / limit", "", "<=", 1.0 + RELATIVE),
    "too_fast": ("started too fast: faster still", "rad/s", "<=", 0.0),
    "position": ("room to position limits", "rad", ">=", -1e-11),
    "outward": ("started outside limits: further out", "rad", "<=", 0.0),
    "deceleration": ("deceleration of the stop / limit", "", "<=", 1.0 + RELATIVE),
    "jump": ("travel in a tick / what v allows", "", "<=", 1.0),
    "parabola": ("off constant acceleration or the stop", "rad", "<=", 1e-11),
    "distance": ("distance - kept distance, at ticks", "m", ">=", -ROUNDING),
    "between": ("distance - kept distance, between ticks", "m", ">=", -COAL),
    "stop": ("distance - kept distance, full stops", "m", ">=", -COAL),
    "stop_position": ("room to position limits, full stops", "rad", ">=", -RELATIVE),
    "coal": ("reported distance off Coal's", "m", "<=", COAL),
    "bystanders": ("pairs apart while others recover", "m", ">=", -COAL),
    "uncertified": ("certificates lost", "", "<=", 0.0),
    "withdrawn": ("kept distance: less than before, and than asked for, by", "m", "<=", 0.0),
    "loosened": ("held objects: kept distance falls by", "m", "<=", 0.0),
    "approach": ("recovery: closer by, in a tick", "m", "<=", 1e-9),
    "not_stopped": ("solver failed: off the stop", "rad", "<=", 1e-11),
    "unsaid": ("solver failed: stop not reported", "", "<=", 0.0),
}


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

    def described(self, value: float) -> str:
        """One value of this promise beside what is allowed."""
        return f"{self.name}: {f'{value:.12g} {self.unit}'.rstrip()}, allowed {self.sense} {self.allowed:.12g}"
