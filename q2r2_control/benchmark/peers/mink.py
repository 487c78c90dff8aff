"""mink: differential inverse kinematics as one QP, on MuJoCo.

mink has position and velocity limits and collision avoidance for chosen pairs of geometries, but no acceleration limit.
Its collision bound is a distance divided by dt, but mink compares the bound with the displacement in one tick.
Therefore mink gets our gain times dt squared, so that its pairs approach each other as fast as ours. mink ignores pairs
of a body and its parent. It gets the MuJoCo model of the simulation, with every monitored capsule. The fingers are
joints in that model; equality constraints keep them still.
"""

from __future__ import annotations

import xml.etree.ElementTree as ET
from collections.abc import Mapping

import mink
import numpy as np
import pinocchio as pin

from q2r2_control.benchmark.peers.base import DETECTION_DISTANCE, PeerSettings
from q2r2_control.plants.mujoco_model import build_model
from q2r2_control.robot.floor import FLOOR
from q2r2_control.robot.pairs import pair_names
from q2r2_control.types import Array


class Mink:
    """mink as a controller of the bench; see the module."""

    limitations = "no acceleration limit; no braking distance to pairs; no pairs of body and parent; no certificate"

    def __init__(self, setup: PeerSettings, name: str) -> None:
        self.name = name
        control, robot = setup.config.control, setup.robot
        bare = setup.config.model_copy(update={"mujoco": setup.config.mujoco.model_copy(update={"objects": {}})})
        self._model = build_model(robot, bare)
        # All bodies collide here, because mink has to keep all monitored pairs apart. In the simulation, the bodies of
        # some of these pairs do not collide.
        self._model.geom_contype[:] = self._model.geom_conaffinity[:] = 1
        joints = [self._model.joint(name) for name in robot.joint_names]
        self._q_index = np.array([joint.qposadr[0] for joint in joints])
        self._v_index = np.array([joint.dofadr[0] for joint in joints])
        for joint, lower, upper in zip(joints, setup.lower, setup.upper, strict=True):
            self._model.jnt_range[joint.id] = lower, upper
        self._rest = self._model.qpos0.copy()
        for name, value in setup.home_of_others.items():
            self._rest[self._model.joint(name).qposadr[0]] = value
        self._configuration = mink.Configuration(self._model)
        self._tasks = {
            arm: mink.FrameTask(
                description.tool_frame, "body", position_cost=1.0, orientation_cost=1.0, gain=setup.position_gain
            )
            for arm, description in robot.arms.items()
        }
        self._posture = mink.PostureTask(self._model, cost=setup.posture_cost, gain=setup.posture_gain)
        self._posture.set_target(self._full(robot.home))
        frozen = sorted(set(range(self._model.nv)) - set(self._v_index.tolist()))
        self._frozen = [mink.DofFreezingTask(self._model, dof_indices=frozen)] if frozen else []
        geometry_of = _mujoco_names(robot.urdf)
        self._limits = [
            mink.ConfigurationLimit(self._model),
            mink.VelocityLimit(self._model, dict(zip(robot.joint_names, setup.velocity, strict=True))),
            mink.CollisionAvoidanceLimit(
                self._model,
                [([geometry_of[a]], [geometry_of[b]]) for a, b in pair_names(robot.collision_model)],
                gain=control.separation_gain * setup.dt**2,
                minimum_distance_from_collisions=setup.min_distance,
                collision_detection_distance=DETECTION_DISTANCE,
            ),
        ]
        self.reset(robot.home)

    def _full(self, q: Array) -> Array:
        full = self._rest.copy()
        full[self._q_index] = q
        return full

    def reset(self, q: Array) -> None:
        self._configuration.update(self._full(q))

    def step(self, targets: Mapping[str, pin.SE3], dt: float) -> tuple[Array, Array]:
        for arm, task in self._tasks.items():
            task.set_target(mink.SE3.from_matrix(targets[arm].homogeneous))
        v = mink.solve_ik(
            self._configuration,
            (*self._tasks.values(), self._posture),
            dt,
            "daqp",
            limits=self._limits,
            constraints=self._frozen,
        )
        self._configuration.integrate_inplace(v, dt)
        return self._configuration.q[self._q_index], v[self._v_index]

    def hold(self) -> tuple[Array, Array]:
        return self._configuration.q[self._q_index], np.zeros(len(self._v_index))


def _mujoco_names(urdf: str) -> dict[str, str]:
    """Return the names of collision shapes in MuJoCo, by their names LINK_0, LINK_1, ... in Pinocchio.

    MuJoCo has the names of the URDF, except for the floor.
    """
    shapes = {
        f"{link.get('name')}_{index}": shape.get("name", "")
        for link in ET.fromstring(urdf).iterfind("link")
        for index, shape in enumerate(link.findall("collision"))
    }
    # The floor has another name, because it is a plane in the simulation.
    return shapes | {f"{FLOOR}_0": FLOOR}
