"""Summary of a run in torque mode: torques, deviation from the reference, and the wall between measured links."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport


@dataclass(slots=True)
class TorqueSummary:
    """A run in torque mode, gathered tick by tick."""

    off_reference_s: dict[str, float]  # of each arm: further from its reference than the impedance's error clip
    min_measured_distance_mm: float | None = None  # None: no monitored pair
    measured_closest_pair: tuple[str, str] | None = None
    pressed_pairs: list[tuple[str, str]] = field(default_factory=list)  # that the wall pushed apart at some time
    max_wall_force_n: float = 0.0  # on one pair
    saturated_ticks: int = 0  # some joint would have needed more torque than its limit
    rate_limited_ticks: int = 0  # some joint's torque could not change as fast as it should
    held_ticks: int = 0  # without a usable measurement: the last gravity torque was held

    def add(self, dt: float, impedance: ImpedanceReport, wall: WallReport) -> None:
        """Count one tick of ``dt`` [s]."""
        least = math.inf if self.min_measured_distance_mm is None else self.min_measured_distance_mm
        # A NaN distance, where nothing was measured, compares as not less; such a tick counts as held.
        if 1e3 * wall.closest_distance < least:
            self.min_measured_distance_mm = 1e3 * wall.closest_distance
            self.measured_closest_pair = wall.closest_pair
        if wall.pressing:
            self.pressed_pairs = sorted({*self.pressed_pairs, *wall.pressing})
        self.max_wall_force_n = max(self.max_wall_force_n, wall.force)
        self.saturated_ticks += bool(impedance.saturated)
        self.rate_limited_ticks += bool(impedance.rate_limited)
        self.held_ticks += impedance.held
        for arm in impedance.clipped:
            self.off_reference_s[arm] += dt
