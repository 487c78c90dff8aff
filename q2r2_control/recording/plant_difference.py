"""How far the tools of a plant are from where they were when the run was recorded."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.recording.recorded_ticks import RecordedTicks
from q2r2_control.robot.robot import Robot
from q2r2_control.summary.tick import Tick


@dataclass(frozen=True, slots=True)
class ArmDifference:
    """Of one arm's measured tool, at the same ticks."""

    position_mm_rms: float
    position_mm_max: float
    rotation_deg_max: float


class PlantDifference:
    """A listener of a replay on a plant."""

    keeps_episodes = True  # as when it was recorded

    def __init__(self, robot: Robot, ticks: RecordedTicks) -> None:
        self._robot, self._ticks = robot, ticks
        self._data = robot.model.createData()
        self._count = 0
        self._squares = dict.fromkeys(robot.arms, 0.0)
        self._farthest = dict.fromkeys(robot.arms, (0.0, 0.0))  # [m], [rad]

    def __call__(self, tick: Tick) -> None:
        """Take one tick of the replay."""
        recorded = self._ticks.current
        if recorded is None or not np.isfinite(recorded.state.q).all():
            return
        self._count += 1
        pin.forwardKinematics(self._robot.model, self._data, recorded.state.q)
        for name, arm in self._robot.arms.items():
            off = pin.updateFramePlacement(self._robot.model, self._data, arm.frame_id).actInv(tick.tools[name])
            distance, angle = float(np.linalg.norm(off.translation)), float(np.linalg.norm(pin.log3(off.rotation)))
            self._squares[name] += distance * distance
            farthest, turned = self._farthest[name]
            self._farthest[name] = max(farthest, distance), max(turned, angle)

    def arms(self) -> dict[str, ArmDifference]:
        """Of each arm; empty where no tick was compared."""
        if not self._count:
            return {}
        return {
            name: ArmDifference(
                1e3 * math.sqrt(self._squares[name] / self._count), 1e3 * farthest, math.degrees(turned)
            )
            for name, (farthest, turned) in self._farthest.items()
        }
