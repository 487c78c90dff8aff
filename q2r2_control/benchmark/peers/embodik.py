"""embodiK: prioritised differential inverse kinematics in C++, on Pinocchio and Coal.

embodiK has position, velocity and acceleration limits, and keeps the nearest pairs apart. It solves no QP: it fixes
joints and rows at their limits one by one. Limits can contradict each other; embodiK then reports an error. It does not
consider braking distances. embodiK gets the same URDF as roboplan, with our bodies as collision shapes, and the same
pairs.

Three of its settings are not the defaults. First, it has rows for the ten nearest pairs at any distance. By default, it
has rows only for pairs within five times the kept distance, here within 5 mm. Second, its mode is MIN_ERROR: tools
get as near to their targets as limits allow. In the default mode SCALE, it reduces a tool's whole velocity until all
limits hold. A tool then stopped 47 mm from its target in free air. Third, both tools have the first priority, and the
posture has the second one. In embodiK, weights are gains, so a small weight cannot make the posture less important than
a tool. The fingers are joints of its model, and their velocity limit is 0.
"""

from __future__ import annotations

import tempfile
from collections.abc import Mapping
from pathlib import Path

import embodik
import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.peers.base import NEAREST_ROWS, PeerSettings
from q2r2_control.benchmark.peers.bodies import urdf_with_our_bodies
from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array


class Embodik:
    """embodiK as a controller of the bench; see the module."""

    limitations = "hard limits that can contradict each other; no braking distance to pairs; no certificate"

    def __init__(self, setup: PeerSettings, name: str) -> None:
        self.name = name
        robot, control = setup.robot, setup.config.control
        with tempfile.TemporaryDirectory() as folder:
            file = Path(folder) / "cell.urdf"
            file.write_text(urdf_with_our_bodies(setup), encoding="utf-8")
            self._model = embodik.RobotModel(str(file))
        joints = self._model.get_joint_names()
        self._indices = np.array([joints.index(joint) for joint in robot.joint_names])
        self._rest = np.zeros(self._model.nq)
        for joint, value in setup.home_of_others.items():
            self._rest[joints.index(joint)] = value
        solver = self._solver = embodik.KinematicsSolver(self._model)
        solver.dt = setup.dt
        self._limit_joints(setup)
        solver.configure_collision_constraint(
            setup.min_distance, pair_names(robot.collision_model), max_constraints=NEAREST_ROWS
        )
        solver.set_proximity_gated_collision_activation_enabled(False)
        self._tools = {}
        for arm, description in robot.arms.items():
            task = self._tools[arm] = solver.add_frame_task(arm, description.tool_frame)
            task.priority, task.weight = 0, control.position_gain
            task.solve_mode = embodik.TaskSolveMode.MIN_ERROR
        posture = solver.add_posture_task("posture", self._indices.tolist())
        posture.priority, posture.weight = 1, control.posture_gain
        posture.set_controlled_joint_targets(robot.home)
        self.reset(robot.home)

    def _limit_joints(self, setup: PeerSettings) -> None:
        """Set our velocity and acceleration limits, and 0 rad/s for fingers. The URDF has the position limits."""
        solver = self._solver
        velocity, acceleration = np.zeros(self._model.nv), np.full(self._model.nv, setup.acceleration.max())
        velocity[self._indices], acceleration[self._indices] = setup.velocity, setup.acceleration
        for index, limit in enumerate(velocity.tolist()):
            solver.set_joint_velocity_limit(index, limit)
        solver.set_acceleration_limits(acceleration)
        solver.enable_position_limits(True)
        solver.enable_velocity_limits(True)
        solver.enable_acceleration_limits(True)

    def reset(self, q: Array) -> None:
        self._q = self._rest.copy()
        self._q[self._indices] = q
        self._solver.set_previous_joint_velocities(np.zeros(self._model.nv))

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        for arm, task in self._tools.items():
            task.set_target_pose(targets[arm].translation, targets[arm].rotation)
        found = self._solver.solve_velocity(self._q)
        if found.status != embodik.SolverStatus.SUCCESS:
            raise RuntimeError(found.status_message)
        v = np.asarray(found.joint_velocities)
        self._solver.set_previous_joint_velocities(v)
        self._q += v * dt
        return self._q[self._indices], v[self._indices]

    def hold(self) -> tuple[Array, Array]:
        self._solver.set_previous_joint_velocities(np.zeros(self._model.nv))
        return self._q[self._indices], np.zeros(len(self._indices))
