"""Report the outcome of a step, and the names of the limits that were active in it."""

from __future__ import annotations

from dataclasses import dataclass

import pinocchio as pin

from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.safety.joint_limits import ACCELERATION, POSITION, VELOCITY
from q2r2_control.control.safety.safety_data import ActiveBounds
from q2r2_control.control.safety.safety_filter import SEPARATION, TOOL_SPEED
from q2r2_control.robot.robot import Robot
from q2r2_control.types import ActiveLimit, LimitKind, StepStatus

_KINDS = {POSITION: LimitKind.POSITION, VELOCITY: LimitKind.VELOCITY, ACCELERATION: LimitKind.ACCELERATION}


class LimitNames:
    """The names of limits and pairs, which kernels know by their indices."""

    def __init__(self, robot: Robot, geometry: pin.GeometryModel) -> None:
        """``geometry`` begins with the robot's own bodies and pairs, as the kernels' arrays do."""
        names = [item.name for item in geometry.geometryObjects]
        pairs = collision_model_of(
            robot, geometry
        ).pairs  # These are not the kernels' own pairs, in which boxes that may be touched have other indices.
        both = zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
        self.pairs = [
            (names[first], names[second]) for first, second in both
        ]  # First come the pairs of the cell, then the pairs of objects, then the pairs of obstacles.
        # Key and result of the last call of :meth:`of`. In most ticks, the same limits are active as in the last tick.
        self._last: tuple[bytes, tuple[ActiveLimit, ...]] = b"", ()
        self._by_kind: dict[int, list[ActiveLimit]] = {
            kind: [ActiveLimit(limit, (joint,)) for joint in robot.joint_names] for kind, limit in _KINDS.items()
        }
        self._by_kind[SEPARATION] = [ActiveLimit(LimitKind.SEPARATION, pair) for pair in self.pairs]
        self._by_kind[TOOL_SPEED] = [ActiveLimit(LimitKind.TOOL_SPEED, (arm,)) for arm in robot.arms]

    def pair(self, number: int) -> tuple[str, str]:
        """Return the names of both bodies of the pair with index ``number``; empty names in a cell without pairs."""
        return self.pairs[number] if self.pairs else ("", "")

    def of(self, active: ActiveBounds) -> tuple[ActiveLimit, ...]:
        """Return the active limits and pairs, each of them once."""
        found = int(active.used[0])
        if not found:
            return ()
        kinds, subjects = active.kind[:found], active.subject[:found]
        key = kinds.tobytes() + subjects.tobytes()
        if key != self._last[0]:
            both = dict.fromkeys(zip(kinds.tolist(), subjects.tolist(), strict=True))
            self._last = key, tuple(self._by_kind[kind][subject] for kind, subject in both)
        return self._last[1]


@dataclass(slots=True)
class StepSummary:
    """Collects the results of the substeps of one tick."""

    fallback: bool = False
    targets_usable: bool = True  # Whether all targets were usable.
    inside: bool = True  # Whether all joints are within their limits.
    unsolved: int = 0  # Bit i is 1 if substep i had no solution.
    slack: float = 0.0
    solve_time: float = 0.0
    faults: tuple[str, ...] = ()  # See :class:`StepReport`.
    constraints: tuple[ActiveLimit, ...] = ()  # The user's own constraints that were active in the last substep.

    def status(self, apart: bool, dt_usable: bool, rejected: tuple[str, ...]) -> StepStatus:
        """Return the most important event of the step as its status."""
        if self.fallback:
            return StepStatus.FALLBACK
        if not (self.inside and apart):
            return StepStatus.RECOVERING
        if not dt_usable:
            return StepStatus.DT_REJECTED
        return StepStatus.TARGET_REJECTED if rejected else StepStatus.OK
