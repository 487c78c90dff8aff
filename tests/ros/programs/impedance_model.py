"""Torques of a task-space or joint impedance on the arms of a robot description: what other controllers command.

It knows nothing of the package under test. Its accelerations are those of a critically damped spring, w^2 e - 2 w v,
in the tool's space for a pose and in the joints' for a posture; the model's inertia makes torques of them.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any
from xml.etree import ElementTree

import numpy as np
import pinocchio as pin

# Low, so that the loop through ROS is stable with delays of up to 80 ms, which an overloaded machine brings.
NATURAL_FREQUENCY = 10.0  # w [rad/s]
NULLSPACE_DAMPING = 10.0  # [1/s]
MAX_ERROR, MAX_TURN = 0.1, 0.5  # the error of a pose is clipped [m, rad]
SINGULAR = 1e-4


class ImpedanceModel:
    """Torques for all revolute joints, in the order of the joint states."""

    def __init__(self, description: str, tools: dict[str, str]) -> None:
        self._model = pin.buildModelFromXML(description)
        for joint in ElementTree.fromstring(description).findall("joint"):
            if (rotor := joint.find("rotor")) is not None:  # no standard element of URDF
                inertia = float(rotor.get("inertia", 0.0)) * float(rotor.get("gear", 1.0)) ** 2
                self._model.armature[self._column(joint.get("name", ""))] = inertia
        self._data = self._model.createData()
        self._frames = {arm: self._model.getFrameId(frame) for arm, frame in tools.items()}
        self._joints: list[str] = []
        self._columns: dict[str, list[int]] = {}  # of each arm
        self.goals: dict[str, Any] = {}  # of each arm: a pose (SE3) or joint positions (7,)

    def measure(self, names: Sequence[str], positions: Sequence[float], velocities: Sequence[float]) -> None:
        """Take a joint state; an arm without a goal gets its posture as the goal."""
        q, v = pin.neutral(self._model), np.zeros(self._model.nv)
        for name, position, velocity in zip(names, positions, velocities, strict=True):
            joint = self._model.joints[self._model.getJointId(name)]
            q[joint.idx_q], v[joint.idx_v] = position, velocity
        if not self._joints:
            self._joints = [name for name in names if self._is_revolute(name)]
            for arm in self._frames:
                self._columns[arm] = [self._column(name) for name in self._joints if name.startswith(arm)]
        self._q, self._v = q, v
        pin.computeJointJacobians(self._model, self._data, q)
        pin.updateFramePlacements(self._model, self._data)
        for arm, columns in self._columns.items():
            self.goals.setdefault(arm, q[columns])

    def joints(self, arm: str) -> list[str]:
        """Names of an arm's joints."""
        return [name for name in self._joints if name.startswith(arm)]

    def positions(self, arm: str) -> Any:
        """Measured joint positions of an arm."""
        return self._q[self._columns[arm]]

    def tool(self, arm: str) -> pin.SE3:
        """Measured pose of an arm's tool, in the world."""
        return self._data.oMf[self._frames[arm]].copy()

    def frame(self, name: str) -> pin.SE3 | None:
        """A link that does not move, in the world."""
        if not self._model.existFrame(name):
            return None
        frame = self._model.frames[self._model.getFrameId(name)]
        return frame.placement.copy() if frame.parentJoint == 0 else None

    def torques(self) -> list[float]:
        """For the goals, at the last measured state."""
        inertia = pin.crba(self._model, self._data, self._q)
        tau = pin.nonLinearEffects(self._model, self._data, self._q, self._v)
        for arm, columns in self._columns.items():
            M, v = inertia[np.ix_(columns, columns)], self._v[columns]
            goal = self.goals[arm]
            if isinstance(goal, pin.SE3):
                tau[columns] += self._to_pose(arm, goal, M, columns, v)
            else:
                tau[columns] += M @ (NATURAL_FREQUENCY**2 * (goal - self._q[columns]) - 2.0 * NATURAL_FREQUENCY * v)
        return [float(tau[self._column(name)]) for name in self._joints]

    def _to_pose(self, arm: str, goal: pin.SE3, M: Any, columns: list[int], v: Any) -> Any:
        tool = self.tool(arm)
        J = pin.getFrameJacobian(self._model, self._data, self._frames[arm], pin.LOCAL_WORLD_ALIGNED)[:, columns]
        error = np.concatenate(
            (
                _clipped(goal.translation - tool.translation, MAX_ERROR),
                _clipped(tool.rotation @ pin.log3(tool.rotation.T @ goal.rotation), MAX_TURN),
            )
        )
        to_tool = np.linalg.solve(M, J.T)
        inertia = np.linalg.inv(J @ to_tool + SINGULAR * np.eye(6))
        force = inertia @ (NATURAL_FREQUENCY**2 * error - 2.0 * NATURAL_FREQUENCY * (J @ v))
        own = -NULLSPACE_DAMPING * v
        return J.T @ force + M @ (own - to_tool @ (inertia @ (J @ own)))

    def _is_revolute(self, name: str) -> bool:
        kind: str = self._model.joints[self._model.getJointId(name)].shortname()
        return kind.startswith("JointModelR")

    def _column(self, name: str) -> int:
        return int(self._model.joints[self._model.getJointId(name)].idx_v)


def _clipped(vector: Any, length: float) -> Any:
    norm = float(np.linalg.norm(vector))
    return vector if norm <= length else vector * (length / norm)
