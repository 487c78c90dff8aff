"""Summary of a run in torque mode: torques, deviation from the reference, and the wall between measured links."""

from __future__ import annotations

from dataclasses import dataclass, field

from q2r2_control.compliance.impedance import ImpedanceReport
from q2r2_control.compliance.repulsion import WallReport


@dataclass(frozen=True, slots=True)
class TorqueSummary:
    """A run in torque mode."""

    min_measured_distance_mm: float | None  # None: no monitored pair
    measured_closest_pair: tuple[str, str] | None
    pressed_pairs: list[tuple[str, str]]  # that the wall pushed apart at some time
    max_wall_force_n: float  # on one pair
    saturated_ticks: int  # some joint would have needed more torque than its limit
    rate_limited_ticks: int  # some joint's torque could not change as fast as it should
    held_ticks: int  # without a usable measurement: the last gravity torque was held
    off_reference_s: dict[str, float]  # of each arm: further from its reference than the impedance's error clip


@dataclass(slots=True)
class TorqueStatistics:
    """Gathers a :class:`TorqueSummary`."""

    _off: dict[str, float]
    _ticks: int = 0
    _distance: float = float("inf")
    _pair: tuple[str, str] | None = None
    _pressed: set[tuple[str, str]] = field(default_factory=set)
    _force: float = 0.0
    _saturated: int = 0
    _rate_limited: int = 0
    _held: int = 0

    @classmethod
    def of(cls, arms: tuple[str, ...]) -> TorqueStatistics:
        """Before the first tick, for the arms named."""
        return cls(dict.fromkeys(arms, 0.0))

    def add(self, dt: float, impedance: ImpedanceReport, wall: WallReport) -> None:
        """Count one tick of ``dt`` [s]."""
        self._ticks += 1
        # A NaN distance, where nothing was measured, compares as not less; such a tick counts as held.
        if wall.closest_distance < self._distance:
            self._distance, self._pair = wall.closest_distance, wall.closest_pair
        self._pressed.update(wall.pressing)
        self._force = max(self._force, wall.force)
        self._saturated += bool(impedance.saturated)
        self._rate_limited += bool(impedance.rate_limited)
        self._held += impedance.held
        for arm in impedance.clipped:
            self._off[arm] += dt

    def summary(self) -> TorqueSummary | None:
        """The run so far; None: not in torque mode."""
        if not self._ticks:
            return None
        return TorqueSummary(
            min_measured_distance_mm=1e3 * self._distance if self._pair else None,
            measured_closest_pair=self._pair,
            pressed_pairs=sorted(self._pressed),
            max_wall_force_n=self._force,
            saturated_ticks=self._saturated,
            rate_limited_ticks=self._rate_limited,
            held_ticks=self._held,
            off_reference_s=dict(self._off),
        )
