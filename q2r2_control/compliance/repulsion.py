"""A repulsive, damped force between measured links, called the wall. It is for torque mode only.

In torque mode, the measured links may deviate from the QP's reference. The reference keeps its distances by itself. If
an arm is pushed away from its reference, the wall pushes it away from other bodies. The command of a tick is

    tau = impedance + gravity and Coriolis + wall

from the q and v that were measured in this tick. The wall is added before torques are saturated.

**The law.** If a monitored pair is closer than its kept distance by the depth x, the wall pushes its bodies apart with

    F = min(k x, F_max) - c(x) d',    clipped to [0, F_max],    tau += (dd/dq)' F.

d is the distance and d' its rate. c is the damping of ratio xi at the pair's effective mass m = 1 / (g' M^-1 g) with
g = dd/dq (Khatib, IJRR 1987); over the first two millimetres of x, it rises from 0 to this value. The torque is
continuous in q and v, and never pulls two bodies together. Its elastic part is the negative gradient of
U = sum k x^2 / 2:  the wall gives back at most the energy that was put in. The law uses the smooth distances of
pair_distance.py. If two long bodies are parallel, the torque therefore does not jump between their ends.

**Why many pairs do not add up to an unstable stiffness.** All pairs act through the same joints. With K = sum k g g'
and D = sum c g g', the largest eigenvalue of M^-1 K is at most its trace, sum k / m. The largest eigenvalue of M^-1 D
is at most sum c / m. If the torque is held over a period h, a mode with stiffness w^2 and damping 2 z is stable exactly
when h w^2 / 2 < 2 z < 2 / h  (Colgate and Schenkel, 1997, for the lower bound). T = 2 ms is the longest period. The
stiffness of all pairs is scaled down together if sum k / m would exceed 0.25 / T^2, and the damping if sum c / m would
exceed 0.5 / T. These values are a quarter of the stable bounds. That suffices for one period of delay, and for masses
that are wrong by a factor of two. Then c > h k / 2 for every pair, as long as no more than 16 pairs are scaled down
together. The only exception is the first hundredths of a millimetre, in which c is still rising. A pair begins to count
in the sums two millimetres outside its kept distance, with a weight that rises from 0 to 1, so that the scale does not
jump. The scale only makes the wall softer. If it is below 1 (never for two iiwa 7 with the default stiffness), the
elastic torque also lacks the part of the gradient of U that comes from the scale.

**The greatest load.** d_min is the distance that a pair keeps. At rest, the wall withstands a force of k d_min or
F_max, whichever is less. In motion, it takes up at most the energy F_max d_min for each pair. The impedance of the
joints takes up further energy. Bodies that meet with more energy are slowed down, but touch. Two fingers with a kept
distance of 1 mm therefore touch if a push of more than 10 N acts on them.

**Fingers** have the same bodies as in the controller, for the openings that the controller has accepted. With bodies
that cover all openings, the wall would push the arms out of postures that the reference may take. If a body of a finger
has grown, no wall acts on it at the posture of the reference. At other postures, a wall may begin to act at once, but
its torque rises no faster than the impedance's rate limit allows.

**Moving obstacles** count only while they are at rest. If an obstacle counted while it moves, each report of its pose
would make x jump. This jump would put the energy k x^2 / 2 into the wall, and push an arm that rests.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.config.control import ControllerSettings, WallSettings
from q2r2_control.config.moving_obstacle import MovingObstacle
from q2r2_control.control.cholesky import factorise
from q2r2_control.control.geometry.closest_points import clamp
from q2r2_control.control.geometry.collision import CollisionData, CollisionModel, collision_model_of, update_placements
from q2r2_control.control.geometry.finger_openings import FingerOpenings
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.geometry.pair_distance import at_least, distance_row, measure, measure_smooth
from q2r2_control.control.jit import bound, kernel
from q2r2_control.control.kernel_pointers import KernelPointer, pointee, pointer_to
from q2r2_control.control.moving_obstacles import write_body
from q2r2_control.robot.kept_distances import kept_by_obstacles, kept_distances
from q2r2_control.robot.obstacle_bodies import with_obstacle_bodies
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array, Interval

_LONGEST_PERIOD = 0.002  # The longest period T of a tick [s].
_STIFFEST = 0.25 / _LONGEST_PERIOD**2  # Largest sum k / m [1/s^2].
_MOST_DAMPED = 0.5 / _LONGEST_PERIOD  # Largest sum c / m [1/s].
# The shell of a pair is its kept distance. Inside the shell, the damping rises from 0 to its value over this distance.
# Outside the shell, the weight of the pair in the sums rises from 0 to 1 over the same distance [m].
_BAND = 0.002
_IMMOBILE = 1e-9  # If the mobility 1 / m of a pair is below this, the joints cannot move the pair [1/kg].
# Smoothing length of distances, relative to the sum of the radii and the kept distance. The error is at most 0.3 mm.
_SMOOTHING = 0.07
# If two cores are closer than this share of the sum of the radii, their distance is measured exactly, because smoothing
# would weaken the force.
_DEEP = 0.25
# If two bodies may touch, their wall begins at the permitted depth. If this share of the sum of their radii is less,
# the wall begins at this share instead.
_SOFT = 0.5
# A moving obstacle that has to have no effect is replaced by this obstacle, which lies far below the cell.
_OUT_OF_REACH = MovingObstacle(shape="sphere", size=(0.1,), position=(0.0, 0.0, -20.0), speed=0.0)


class RepulsionModel(NamedTuple):
    """Data that do not change between ticks."""

    collision: CollisionModel
    smoothing: Array  # (p,) The weight e that smooths the distance, see pair_distance.py [m^2].
    deep: Array  # (p,) If the distance of a pair is below this, it is not smoothed [m].
    shell: Array  # (p,) Distance that the pair keeps [m].
    stiffness: float  # [N/m]
    damping_ratio: float
    maximum_force: float  # [N]


class RepulsionData(NamedTuple):
    """The measurement of one tick, and arrays that are written in this tick."""

    measured: Array  # (2, nv) The measured q and v.
    M: Array  # (nv, nv) Mass matrix, of which the upper triangle is read. It is overwritten with its Cholesky factor.
    collision: CollisionData  # Collision data at q.
    near: IntArray  # (p,) Indices of the near pairs, which are inside the shell or just outside.
    depth: Array  # (p,) Depths of the near pairs [m].
    rows: Array  # (p, nv) Gradients of the distances of the near pairs.
    mobility: Array  # (p,) 1 / m of the near pairs [1/kg].
    force: Array  # (p,) Forces of the wall on the near pairs [N].
    row: Array  # (nv,) Buffer for L^-1 g of one pair.
    tau: Array  # (nv,) Torque of the wall [Nm].

    @classmethod
    def empty(cls, model: RepulsionModel) -> RepulsionData:
        pairs, nv = len(model.collision.pairs.first), len(model.collision.chain.parent) - 1
        return cls(
            measured=np.zeros((2, nv)),
            M=np.eye(nv),
            collision=CollisionData.empty(model.collision),
            near=np.zeros(pairs, dtype=np.int64),
            depth=np.zeros(pairs),
            rows=np.zeros((pairs, nv)),
            mobility=np.zeros(pairs),
            force=np.zeros(pairs),
            row=np.zeros(nv),
            tau=np.zeros(nv),
        )


@kernel
def find_near(model_pointer: KernelPointer, data_pointer: KernelPointer) -> tuple[int, int, float]:
    """Write depths and gradients of the near pairs, which are inside the shell or just outside.

    Returns the number of near pairs, the index of the closest of all pairs, and the distance of this pair [m]. If q or
    v is not finite, the number is -1.
    """
    model, data = pointee(model_pointer), pointee(data_pointer)
    if not np.isfinite(data.measured.sum()):
        return -1, 0, np.nan
    update_placements(model.collision, data.collision, data.measured[0])
    count, closest, least = 0, 0, np.inf
    for p in range(model.collision.pairs.first.shape[0]):
        if at_least(model.collision, data.collision, p) >= max(least, model.shell[p] + _BAND):
            continue
        distance = measure(model.collision, data.collision, p)
        # The bodies of a pair that may touch can overlap. Their distance is then negative, and counts as 0 when the
        # closest pair is searched. Otherwise a pair that must not touch, and that overlaps less, would not be found.
        apart = max(distance, 0.0) if model.shell[p] < 0.0 else distance
        if apart < least:
            least, closest = apart, p
        # The smooth distance is never smaller than ``distance``, so the pair is not near by the smooth distance either.
        if distance >= model.shell[p] + _BAND:
            continue
        if distance > model.deep[p]:
            distance = measure_smooth(model.collision, data.collision, p, model.smoothing[p])
        data.near[count] = p
        data.depth[count] = model.shell[p] - distance
        distance_row(model.collision, data.collision, p, data.rows[count])
        count += 1
    return count, closest, least


@kernel
def repulsion_torque(model_pointer: KernelPointer, data_pointer: KernelPointer, count: int) -> float:
    """Add up the torques of the ``count`` near pairs, and return the energy stored in the wall [J]."""
    model, data, v = pointee(model_pointer), pointee(data_pointer), pointee(data_pointer).measured[1]
    depth, mobility, force = data.depth, data.mobility, data.force
    factorise(data.M)
    total = 0.0
    for i in range(count):
        mobility[i] = _mobility(data.M, data.rows[i], data.row)
        total += model.stiffness * mobility[i] * clamp(1.0 + depth[i] / _BAND, 0.0, 1.0)
    stiffness = model.stiffness * min(1.0, _STIFFEST / max(total, _IMMOBILE))
    total = 0.0
    for i in range(count):
        # c = 2 xi sqrt(k m), thus c / m = 2 xi sqrt(k / m).
        share = clamp(depth[i] / _BAND, 0.0, 1.0)
        total += share * 2.0 * model.damping_ratio * np.sqrt(stiffness * mobility[i])
    damping = 2.0 * model.damping_ratio * min(1.0, _MOST_DAMPED / max(total, _IMMOBILE))
    data.tau[:] = 0.0
    energy = 0.0
    softest = model.maximum_force / stiffness  # From this depth on, the force is constant.
    for i in range(count):
        force[i] = 0.0
        x = depth[i]
        if x <= 0.0 or mobility[i] <= _IMMOBILE:
            continue
        rate = 0.0
        for j in range(v.shape[0]):
            rate += data.rows[i, j] * v[j]
        elastic = stiffness * min(x, softest)
        damped = damping * np.sqrt(stiffness / mobility[i]) * clamp(x / _BAND, 0.0, 1.0) * rate
        force[i] = clamp(elastic - damped, 0.0, model.maximum_force)
        energy += elastic * (x - 0.5 * min(x, softest))
        for j in range(v.shape[0]):
            data.tau[j] += force[i] * data.rows[i, j]
    return energy


@kernel
def _mobility(factor: Array, row: Array, out: Array) -> float:
    """Return the inverse of the effective mass along ``row``, g' M^-1 g = |L^-1 g|^2 [1/kg]."""
    total = 0.0
    for i in range(row.shape[0]):
        value = row[i]
        for k in range(i):
            value -= factor[i, k] * out[k]
        out[i] = value / factor[i, i]
        total += out[i] * out[i]
    return total


@dataclass(slots=True)
class WallReport:
    """The wall's action in one tick."""

    tau: Array  # (nv,) Torque of the wall, which is added to the other torques [Nm].
    pressing: tuple[tuple[str, str], ...]  # Names of the bodies that the wall pushes apart.
    force: float  # The largest force of a pair [N].
    energy: float  # Energy stored in the wall [J].
    closest_pair: tuple[str, str]  # The closest pair of measured bodies.
    # The distance of this pair [m]; 0 if it may touch and penetrates; NaN if q or v is not finite.
    closest_distance: float


class MeasuredSeparation:
    """Pushes measured links apart in torque mode. The torque depends only on the measurement of the present tick."""

    def __init__(self, robot: Robot, settings: ControllerSettings, wall_settings: WallSettings | None = None) -> None:
        """Make a wall that begins at the distances that pairs keep according to ``settings``.

        Raises :class:`RobotError` if the kernels cannot measure a body's shape, and :class:`ConfigError` if the
        settings do not fit the robot.
        """
        law, self._model, self._data = wall_settings or WallSettings(), robot.model, robot.model.createData()
        geometry = with_obstacle_bodies(robot, settings.moving_obstacles, held=False)
        names = [item.name for item in geometry.geometryObjects]
        self._obstacles = {name: names.index(f"{name}_0") for name in settings.moving_obstacles}
        collision = collision_model_of(robot, geometry)
        pairs = collision.pairs
        self._bodies, self._pairs = collision.bodies, pairs
        self._shell, self._smoothing, self._deep = np.zeros((3, len(pairs.first)))
        # One row for each obstacle: the distances that its pairs keep. The last pairs of a row are the pairs with held
        # objects, and are left out.
        by_obstacle = kept_by_obstacles(robot, settings).values.reshape(max(len(self._obstacles), 1), -1)
        count = by_obstacle.shape[1] - len(robot.objects.by_arm) if self._obstacles else 0
        self._kept_by_obstacles = by_obstacle[:, :count].ravel()
        self._kept = kept_distances(robot, settings).values
        self.set_obstacles({})
        by_pair = self._smoothing, self._deep, self._shell
        model = RepulsionModel(collision, *by_pair, law.stiffness, law.damping_ratio, law.maximum_force)
        self._fingers = FingerOpenings(robot, collision.bodies)
        self._kernel_data = RepulsionData.empty(model)
        self._measured = self._kernel_data.measured.reshape(-1)  # A view of ``measured``, which has the same memory.
        self._model_pointer, self._data_pointer = pointer_to(model), pointer_to(self._kernel_data)
        self._pair_names = [(names[one], names[other]) for one, other in zip(pairs.first, pairs.second, strict=True)]
        # Every kernel runs once here, so that no kernel is compiled during a motion.
        self._find_near = bound(find_near, self._model_pointer, self._data_pointer)
        self._repulsion_torque = bound(repulsion_torque, self._model_pointer, self._data_pointer, 0)
        self._no_torque = np.zeros(robot.model.nv)
        self._no_torque.flags.writeable = False

    def set_openings(self, openings: Mapping[str, Interval]) -> None:
        """Set the interval of openings of each arm's gripper. An arm that is not named gets the whole interval."""
        self._fingers.set_all(openings)
        if self._fingers.turn:
            self.set_kept_distances(self._kept)

    def set_obstacles(self, obstacles: Mapping[str, MovingObstacle]) -> None:
        """Set the moving obstacles that are at rest, by name. All other moving obstacles have no effect on the arms."""
        for name, number in self._obstacles.items():
            write_body(self._bodies, number, obstacles.get(name, _OUT_OF_REACH))
        self.set_kept_distances(self._kept)

    def set_kept_distances(self, kept: Array) -> None:
        """Set the distance (p,) [m] that every pair keeps. The wall of a pair begins at this distance."""
        self._kept, radius = kept, self._bodies.radius
        radii = radius[self._pairs.first] + radius[self._pairs.second]
        self._deep[:] = (_DEEP - 1.0) * radii
        # For pairs that may touch, the wall begins at a depth that an ordinary touch does not reach.
        self._shell[:] = np.maximum(np.append(kept, self._kept_by_obstacles), -_SOFT * radii)
        self._smoothing[:] = (_SMOOTHING * (radii + self._shell)) ** 2

    def update(self, q: Array, v: Array) -> WallReport:
        """Return the wall's torque at the measured ``q`` [rad] and ``v`` [rad/s], (nv,) each.

        If a number is not finite, no exception is raised: the torque is then zero, because the posture is unknown.
        """
        np.concatenate((q, v), out=self._measured)
        count, closest, distance = self._find_near(self._model_pointer, self._data_pointer)
        if count < 0:
            return WallReport(self._no_torque, (), 0.0, 0.0, ("", ""), math.nan)
        pair = self._pair_names[closest] if self._pair_names else ("", "")
        data, energy = self._kernel_data, 0.0
        if count:
            data.M[:] = pin.crba(self._model, self._data, data.measured[0])
            energy = float(self._repulsion_torque(self._model_pointer, self._data_pointer, count))
        if not energy:
            return WallReport(self._no_torque, (), 0.0, 0.0, pair, distance)
        force = data.force[:count]
        pressing = tuple(self._pair_names[data.near[i]] for i in np.flatnonzero(force > 0.0))
        return WallReport(data.tau.copy(), pressing, float(force.max()), energy, pair, distance)
