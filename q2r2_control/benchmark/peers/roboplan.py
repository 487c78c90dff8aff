"""roboplan: OInK, differential inverse kinematics as one QP in C++, on Pinocchio, Coal and ProxQP.

roboplan has position, velocity and acceleration limits and a barrier on the nearest pairs. All of them are hard
constraints. If they contradict each other, roboplan raises an exception. The barrier does not consider braking
distances. roboplan gets the same URDF as our controller, with our margins in its position limits, and with our bodies
instead of its collision shapes. It has the same pairs, the smallest distance that we keep, and rows for all pairs or
for the ten nearest pairs.

By default, its solver looks for the nearest feasible problem if limits contradict each other. Tools then follow some
targets more closely, but one tick took up to a minute, so this is switched off. The limit of iterations is a tenth of
the default, because single ticks still took minutes. The tolerance of the solver is the default (1e-6 rad per tick),
because with smaller tolerances a tick took up to two minutes. By default, the damping towards a safe displacement has
the gain 1. Here this damping is switched off, because with it the tools hardly follow at ticks of 1 ms.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import combinations

import numpy as np
import pinocchio as pin
from roboplan import core, optimal_ik

from q2r2_control.benchmark.peers.base import DETECTION_DISTANCE, NEAREST_ROWS, PeerSettings
from q2r2_control.benchmark.peers.bodies import urdf_with_our_bodies
from q2r2_control.robot.pairs import link_of, pair_names
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_GROUP = "arms"
_REGULARISATION = 1e-6
_ITERATIONS = 1000


class Roboplan:
    """roboplan as a controller of the bench; see the module."""

    limitations = "hard limits that can contradict each other; no braking distance to pairs; no certificate"

    def __init__(self, setup: PeerSettings, name: str) -> None:
        self.name = name
        robot, control, dt = setup.robot, setup.config.control, setup.dt
        self._scene = core.Scene(robot.name, core.loadUrdfSceneDescriptionFromXml(urdf_with_our_bodies(setup)))
        self._scene.addGroup(_GROUP, list(robot.joint_names))
        _watch_pairs(self._scene, robot)
        solver = optimal_ik.OinkSettings()
        solver.primal_infeasibility_solving = False
        solver.max_iter = _ITERATIONS
        self._ik = optimal_ik.Oink(self._scene, _GROUP, solver)
        self._indices = np.array(self._ik.q_indices)
        self._rest = np.array(self._scene.getCurrentJointPositions())
        for joint, value in setup.home_of_others.items():
            self._rest[self._scene.getJointPositionIndices([joint])] = value
        nv = robot.model.nv
        self._frame_tasks = {arm: self._frame_task(setup, arm) for arm in robot.arms}
        posture = optimal_ik.ConfigurationTask(
            self._ik,
            robot.home,
            # Here roboplan takes a weight. The costs of its other tasks are roots of weights, because it squares them.
            np.full(nv, control.posture_weight),
            optimal_ik.ConfigurationTaskOptions(task_gain=setup.posture_gain),
        )
        self._tasks = [*self._frame_tasks.values(), posture]
        self._acceleration = optimal_ik.AccelerationLimit(self._ik, dt, setup.acceleration)
        velocity = optimal_ik.VelocityLimit(self._ik, dt, setup.velocity)
        self._constraints = [optimal_ik.PositionLimit(self._ik), velocity, self._acceleration]
        pairs = len(robot.collision_model.collisionPairs)
        barrier = optimal_ik.SelfCollisionBarrierOptions(
            n_collision_pairs=max(1, NEAREST_ROWS if "nearest" in name else pairs),
            gain=control.separation_gain,
            d_min=setup.min_distance,
            safe_displacement_gain=0.0,
            d_max=DETECTION_DISTANCE,
        )
        self._barriers = [optimal_ik.SelfCollisionBarrier(self._ik, self._scene, dt, barrier)]
        self.reset(robot.home)

    def _frame_task(self, setup: PeerSettings, arm: str) -> optimal_ik.FrameTask:
        control = setup.config.control
        options = optimal_ik.FrameTaskOptions(
            task_gain=setup.position_gain,
            max_position_error=control.max_linear_speed / control.position_gain,
            max_rotation_error=control.max_angular_speed / control.rotation_gain,
        )
        goal = core.CartesianConfiguration("", setup.robot.arms[arm].tool_frame, np.eye(4))
        return optimal_ik.FrameTask(self._ik, self._scene, goal, options)

    def reset(self, q: Array) -> None:
        self._q = self._rest.copy()
        self._q[self._indices] = q
        self._acceleration.reset()

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        for arm, task in self._frame_tasks.items():
            task.setTargetFrameTransform(targets[arm].homogeneous)
        step = np.zeros(len(self._indices))
        self._ik.solveIk(self._q, self._tasks, self._constraints, self._barriers, step, _REGULARISATION)
        self._q[self._indices] += step
        v = step / dt
        self._acceleration.setLastVelocity(v)
        return self._q[self._indices], v

    def hold(self) -> tuple[Array, Array]:
        self._acceleration.reset()
        return self._q[self._indices], np.zeros(len(self._indices))


def _watch_pairs(scene: core.Scene, robot: Robot) -> None:
    """Let the scene check the pairs of links that belong to our monitored pairs, and no others."""
    links = sorted({link_of(geometry.name) for geometry in robot.collision_model.geometryObjects})
    watched = {frozenset((link_of(a), link_of(b))) for a, b in pair_names(robot.collision_model)}
    pairs = list(combinations(links, 2))
    scene.setCollisions([pair for pair in pairs if frozenset(pair) in watched], True)
    scene.setCollisions([pair for pair in pairs if frozenset(pair) not in watched], False)
