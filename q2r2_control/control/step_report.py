"""The report of a step: its outcome, and the names of the limits that held it back."""

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
    """Names of limits and pairs, by the numbers that kernels know them by."""

    def __init__(self, robot: Robot, geometry: pin.GeometryModel) -> None:
        """``geometry`` begins with the robot's, as the kernels' bodies and pairs do."""
        names = [item.name for item in geometry.geometryObjects]
        pairs = collision_model_of(
            robot, geometry
        ).pairs  # the kernels' know boxes that may be touched by other numbers
        both = zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
        self.pairs = [
            (names[first], names[second]) for first, second in both
        ]  # of the cell, then of objects, then of obstacles
        self._last: tuple[bytes, tuple[ActiveLimit, ...]] = b"", ()  # most ticks bind as the one before
        self._by_kind: dict[int, list[ActiveLimit]] = {
            kind: [ActiveLimit(limit, (joint,)) for joint in robot.joint_names] for kind, limit in _KINDS.items()
        }
        self._by_kind[SEPARATION] = [ActiveLimit(LimitKind.SEPARATION, pair) for pair in self.pairs]
        self._by_kind[TOOL_SPEED] = [ActiveLimit(LimitKind.TOOL_SPEED, (arm,)) for arm in robot.arms]

    def pair(self, number: int) -> tuple[str, str]:
        """Both bodies of a pair; empty names in a cell without pairs."""
        return self.pairs[number] if self.pairs else ("", "")

    def of(self, active: ActiveBounds) -> tuple[ActiveLimit, ...]:
        """Limits and pairs, each once."""
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
    """The sum of the substeps of one tick."""

    fallback: bool = False
    targets_usable: bool = True  # all of them
    inside: bool = True  # all joints are within their limits
    unsolved: int = 0  # bit by bit, which substeps had no solution
    slack: float = 0.0
    solve_time: float = 0.0
    faults: tuple[str, ...] = ()  # of tasks and constraints of a program's own
    constraints: tuple[ActiveLimit, ...] = ()  # of a program's own that the last substep met

    def status(self, apart: bool, dt_usable: bool, rejected: tuple[str, ...]) -> StepStatus:
        """The most important of what happened."""
        if self.fallback:
            return StepStatus.FALLBACK
        if not (self.inside and apart):
            return StepStatus.RECOVERING
        if not dt_usable:
            return StepStatus.DT_REJECTED
        return StepStatus.TARGET_REJECTED if rejected else StepStatus.OK
