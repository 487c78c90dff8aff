"""A repulsive, damped wall between the measured links, for torque mode, where they may leave the QP's reference.

In the tick it comes after the QP, beside the impedance:  tau = impedance + gravity and Coriolis + wall,  from the
measured q and v of the same tick and before torques are saturated. The reference keeps its distances by itself; an arm
that is pushed away from it meets this wall. The law, and why it is stable, stands in repulsion_kernels.py.

**What it can take.** d_min is the distance that a pair keeps. At rest a force of k d_min or F_max, whichever is less.
In motion it takes up at most the energy F_max d_min for each pair, beside what the joints take; bodies that meet with
more than that are slowed down, but touch. So fingers that may come within a millimetre touch at a push of 10 N.

**Fingers** are the same bodies here as in the controller, at the openings that it has accepted: a wall around all of
their way would push the arms out of postures that the reference may take. A body that has grown meets no pair at the
reference, and what it makes the wall push where the arm is elsewhere comes at the rate of torques that the impedance
allows.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import pinocchio as pin

from q2r2_control.compliance.repulsion_kernels import RepulsionData, RepulsionModel, find_near, repulsion_torque
from q2r2_control.config.control import ControllerSettings, WallSettings
from q2r2_control.control.geometry.collision import collision_model_of
from q2r2_control.control.geometry.finger_openings import FingerOpenings
from q2r2_control.control.jit import bound, pointer_to
from q2r2_control.robot.kept_distances import kept_distances
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Interval

# Of the sum of radii and the distance that a pair keeps: the smoothing length of distances, 0.3 mm of error at most.
_SMOOTHING = 0.07
# Cores closer than this part of the radii are measured as they are: so deep, the smoothing would weaken the force.
_DEEP = 0.25
# Of the radii: how deep two bodies that may touch have to be in each other before the wall pushes.
_SOFT = 0.5


@dataclass(slots=True)  # not frozen: that would cost half a microsecond a tick
class WallReport:
    """What the wall does in one tick."""

    tau: Array  # (nv,) to be added to the commanded torque [Nm]
    pressing: tuple[tuple[str, str], ...]  # geometry names of the pairs that the wall pushes apart
    force: float  # the largest of them [N]
    energy: float  # stored in the wall [J]
    closest_pair: tuple[str, str]  # measured
    closest_distance: float  # [m]; NaN if q or v is not finite


class MeasuredSeparation:
    """Keeps the measured links apart in torque mode. Holds nothing between ticks but scratch."""

    def __init__(self, robot: Robot, settings: ControllerSettings, wall_settings: WallSettings | None = None) -> None:
        """Uses the distances that pairs keep of ``settings``.

        Raises :class:`RobotError` for a shape that no kernel measures, :class:`ConfigError` as the controller does.
        """
        law, self._model, self._data = wall_settings or WallSettings(), robot.model, robot.model.createData()
        collision = collision_model_of(robot)
        pairs, radius = collision.pairs, collision.bodies.radius
        self._bodies, self._pairs = collision.bodies, pairs
        self._radii = radius[pairs.first] + radius[pairs.second]
        self._shell, self._smoothing, self._deep = (np.zeros_like(self._radii) for _ in range(3))
        self.set_kept_distances(kept_distances(robot, settings).values)
        model = RepulsionModel(
            collision=collision,
            smoothing=self._smoothing,
            deep=self._deep,
            shell=self._shell,
            stiffness=law.stiffness,
            damping_ratio=law.damping_ratio,
            maximum_force=law.maximum_force,
        )
        self._fingers = FingerOpenings(robot, collision.bodies)
        self._kernel_data = RepulsionData.empty(model)
        self._measured = self._kernel_data.measured.reshape(-1)  # a view
        self._model_pointer, self._data_pointer = pointer_to(model), pointer_to(self._kernel_data)
        names = [geometry.name for geometry in robot.collision_model.geometryObjects]
        indices = zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
        self._pair_names = [(names[first], names[second]) for first, second in indices]
        # Every kernel runs once here, so that none is compiled in mid-motion.
        self._find_near = bound(find_near, self._model_pointer, self._data_pointer)
        self._repulsion_torque = bound(repulsion_torque, self._model_pointer, self._data_pointer, 0)
        self._no_torque = np.zeros(robot.model.nv)
        self._no_torque.flags.writeable = False

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        """Between which openings each arm's gripper is; of an arm that is not named, all of the way."""
        self._fingers.set_all(openings)
        if self._fingers.turn:
            radius = self._bodies.radius
            self._radii = radius[self._pairs.first] + radius[self._pairs.second]
            self.set_kept_distances(self._kept)

    def set_kept_distances(self, kept: Array) -> None:
        """How far apart every pair stays, (p,) [m], which is where its wall begins."""
        self._kept = kept
        self._deep[:] = (_DEEP - 1.0) * self._radii
        # Pairs that may touch meet the wall only where they are deeper in each other than bodies get that touch.
        self._shell[:] = np.maximum(kept, -_SOFT * self._radii)
        self._smoothing[:] = (_SMOOTHING * (self._radii + self._shell)) ** 2

    def update(self, q: Array, v: Array) -> WallReport:
        """Wall torque at the measured ``q`` [rad] and ``v`` [rad/s], (nv,) each.

        Never raises because of a number: where one is not finite nothing can be known, and no torque is given.
        """
        count, closest, distance = self._find(q, v)
        if count < 0:
            return WallReport(self._no_torque, (), 0.0, 0.0, ("", ""), math.nan)
        energy = self._press(count) if count else 0.0
        pair = self._pair_names[closest] if self._pair_names else ("", "")
        if not energy:
            return WallReport(self._no_torque, (), 0.0, 0.0, pair, distance)
        force = self._kernel_data.force[:count]
        pressing = tuple(self._pair_names[self._kernel_data.near[i]] for i in np.flatnonzero(force > 0.0))
        return WallReport(self._kernel_data.tau.copy(), pressing, float(force.max()), energy, pair, distance)

    def _find(self, q: Array, v: Array) -> tuple[int, int, float]:
        np.concatenate((q, v), out=self._measured)
        found: tuple[int, int, float] = self._find_near(self._model_pointer, self._data_pointer)
        return found

    def _press(self, count: int) -> float:
        self._kernel_data.M[:] = pin.crba(self._model, self._data, self._kernel_data.measured[0])
        return float(self._repulsion_torque(self._model_pointer, self._data_pointer, count))
