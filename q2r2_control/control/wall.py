"""A repulsive, damped wall between the measured links, for torque mode, where they may leave the QP's reference.

In the tick it comes after the QP: ``tau = impedance + gravity and Coriolis + wall``, from the measured q and v of the
same tick, before torques are saturated. The reference keeps min_distance by itself; pushed away from it, the measured
arm meets this wall. Each monitored pair closer than min_distance by the depth x presses itself apart with the force

    F = min(k x, F_max) - c(x) d',    clipped to [0, F_max],    tau += (dd/dq)' F,

d' the rate of distance, c the damping of ratio xi at the pair's effective mass m = 1 / (g' M^-1 g), g = dd/dq
(Khatib, IJRR 1987), rising from 0 to its value in the first two millimetres. So the torque is continuous in q and v,
never pulls two bodies together, and its elastic part is the gradient of  U = sum k x^2 / 2:  what the wall gives back
is at most what was put in. Distances are those of smooth.py, so that bodies that lie along each other do not make the
torque switch from end to end.

**Why many pairs do not add up to an unstable stiffness.** Each wrist link presses against each link nearby, and all
pairs act through the same joints. With K = sum k g g' and D = sum c g g' the fastest mode of M^-1 K is no faster than
the trace, sum k / m, and that of M^-1 D no faster than sum c / m. Held over a period h, a mode with stiffness w^2 and
damping 2 z is stable exactly when  h w^2 / 2 < 2 z < 2 / h  (Colgate and Schenkel, 1997, for the lower bound). With
T = 2 ms, the longest period, the stiffness of all pairs is scaled down together where sum k / m would exceed
0.25 / T^2, and the damping where sum c / m would exceed 0.5 / T, a quarter of what is stable: enough for one period
of delay and for masses wrong by a factor of two. What is left satisfies c > h k / 2 for every pair while no more than
16 are scaled down together. A pair's share in the sums fades in over two millimetres outside the shell, so that the
scale does not jump. With the default stiffness two KUKA arms of 7 kg to 14 kg are never scaled down in stiffness.

**What it can take.** At rest k min_distance or F_max, whichever is less; in motion the energy F_max min_distance for
each pair (4 J with the defaults) beside what the joints damp. Of bodies that meet faster than that it takes the sting.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import pinocchio as pin
from pydantic import BaseModel, ConfigDict, Field

from q2r2_control.control.chain import Chain, IntArray, Placements, chain_of, place
from q2r2_control.control.collision import (
    Bodies,
    Contact,
    Pairs,
    Posed,
    at_least,
    bodies_of,
    distance_row,
    measure,
    pairs_of,
    pose_bodies,
)
from q2r2_control.control.geometry import clamp
from q2r2_control.control.jit import Held, hold, kernel, lean_kernel
from q2r2_control.control.settings import ControllerSettings
from q2r2_control.control.smooth import smooth_distance
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

_LONGEST_PERIOD = 0.002  # T [s]
_STIFFEST = 0.25 / _LONGEST_PERIOD**2  # of sum k / m [1/s^2]
_MOST_DAMPED = 0.5 / _LONGEST_PERIOD  # of sum c / m [1/s]
_BAND = 0.002  # over which damping fades in inside the shell, and a pair's share in the sums outside it [m]
# Of the sum of radii and min_distance: the smoothing length of distances, 0.3 mm of error at most.
_SMOOTHING = 0.07
# Cores closer than this part of the radii are measured as they are: so deep, the smoothing would weaken the force.
_DEEP = 0.25
_IMMOBILE = 1e-9  # [1/kg]


class WallSettings(BaseModel):
    """The wall between measured links; its depth is the controller's ``min_distance``."""

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    stiffness: float = Field(10000.0, gt=0, le=100000, description="force per depth below min_distance [N/m]")
    damping_ratio: float = Field(1.0, ge=0.2, le=2, description="at each pair's effective mass")
    maximum_force: float = Field(200.0, gt=0, le=2000, description="of each pair of links [N]")


class _Wall(NamedTuple):
    chain: Chain
    bodies: Bodies
    pairs: Pairs
    smoothing: Array  # (p,) [m^2]
    deep: Array  # (p,) distance from which it is measured as it is [m]
    shell: float  # min_distance [m]
    stiffness: float
    damping_ratio: float
    maximum_force: float


class _Scratch(NamedTuple):
    q: Array  # (nv,)
    v: Array  # (nv,)
    M: Array  # (nv, nv) its upper triangle; the lower one and the diagonal's roots are overwritten
    placements: Placements
    posed: Posed
    contact: Contact
    near: IntArray  # (p,) pairs in the shell or just outside
    depth: Array  # (p,) of them [m]
    rows: Array  # (p, nv) gradients of their distances
    mobility: Array  # (p,) 1 / m [1/kg]
    force: Array  # (p,) [N]
    row: Array  # (nv,)
    tau: Array  # (nv,)


@dataclass(frozen=True, slots=True)
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
        """Uses ``min_distance`` of ``settings``. Raises :class:`RobotError` for a shape that no kernel measures."""
        law, self._model, self._data = wall_settings or WallSettings(), robot.model, robot.model.createData()
        chain, bodies = chain_of(robot.model), bodies_of(robot.collision_model)
        travel = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
        pairs = pairs_of(robot.collision_model, chain, bodies, travel)
        radii = bodies.radius[pairs.first] + bodies.radius[pairs.second]
        self._scratch = _scratch_of(chain, bodies, len(pairs.first), robot.model.nv)
        self._held_scratch = hold(self._scratch)
        self._held_wall = hold(
            _Wall(
                chain=chain,
                bodies=bodies,
                pairs=pairs,
                smoothing=(_SMOOTHING * (radii + settings.min_distance)) ** 2,
                deep=(_DEEP - 1.0) * radii,
                shell=settings.min_distance,
                stiffness=law.stiffness,
                damping_ratio=law.damping_ratio,
                maximum_force=law.maximum_force,
            )
        )
        names = [geometry.name for geometry in robot.collision_model.geometryObjects]
        indices = zip(pairs.first.tolist(), pairs.second.tolist(), strict=True)
        self._pair_names = [(names[first], names[second]) for first, second in indices]
        # Every kernel runs once here, so that none is compiled in mid-motion.
        self._find(robot.home, np.zeros(robot.model.nv))
        self._press(0)

    def update(self, q: Array, v: Array) -> WallReport:
        """Wall torque at the measured ``q`` [rad] and ``v`` [rad/s], (nv,) each.

        Never raises because of a number: where one is not finite nothing can be known, and no torque is given.
        """
        if not (math.isfinite(q.sum()) and math.isfinite(v.sum())):
            return WallReport(np.zeros(len(q)), (), 0.0, 0.0, ("", ""), math.nan)
        count, closest, distance = self._find(q, v)
        energy = self._press(count) if count else 0.0
        pair = self._pair_names[closest] if self._pair_names else ("", "")
        if not energy:
            return WallReport(np.zeros(len(q)), (), 0.0, 0.0, pair, distance)
        force = self._scratch.force[:count]
        pressing = tuple(self._pair_names[self._scratch.near[i]] for i in np.flatnonzero(force > 0.0))
        return WallReport(self._scratch.tau.copy(), pressing, float(force.max()), energy, pair, distance)

    def _find(self, q: Array, v: Array) -> tuple[int, int, float]:
        self._scratch.q[:] = q
        self._scratch.v[:] = v
        found: tuple[int, int, float] = _find_near(self._held_wall, self._held_scratch)
        return found

    def _press(self, count: int) -> float:
        self._scratch.M[:] = pin.crba(self._model, self._data, self._scratch.q)
        return float(wall_torque(self._held_wall, self._held_scratch, count))


def _scratch_of(chain: Chain, bodies: Bodies, pairs: int, nv: int) -> _Scratch:
    return _Scratch(
        q=np.zeros(nv),
        v=np.zeros(nv),
        M=np.eye(nv),
        placements=Placements.empty(chain),
        posed=Posed.empty(bodies),
        contact=Contact.empty(),
        near=np.zeros(pairs, dtype=np.int64),
        depth=np.zeros(pairs),
        rows=np.zeros((pairs, nv)),
        mobility=np.zeros(pairs),
        force=np.zeros(pairs),
        row=np.zeros(nv),
        tau=np.zeros(nv),
    )


@kernel
def _find_near(held_wall: Held, held_scratch: Held) -> tuple[int, int, float]:
    """Depths and gradients of the pairs in the shell or just outside.

    Returns how many these are, the closest pair of all and its distance.
    """
    wall, scratch = held_wall.value, held_scratch.value
    bodies, pairs, posed, contact = wall.bodies, wall.pairs, scratch.posed, scratch.contact
    place(wall.chain, scratch.q, scratch.placements)
    pose_bodies(bodies, scratch.placements, posed)
    count, closest, least = 0, 0, np.inf
    for p in range(pairs.first.shape[0]):
        first, second = pairs.first[p], pairs.second[p]
        if at_least(bodies, posed, first, second) >= max(least, wall.shell + _BAND):
            continue
        distance = measure(bodies, posed, first, second, posed.start[first], posed.end[first], contact)
        if distance < least:
            least, closest = distance, p
        # The smooth distance is no smaller.
        if distance >= wall.shell + _BAND:
            continue
        if distance > wall.deep[p]:
            distance = smooth_distance(bodies, posed, first, second, wall.smoothing[p], contact)
        scratch.near[count] = p
        scratch.depth[count] = wall.shell - distance
        distance_row(wall.chain, scratch.placements, pairs, p, contact, scratch.rows[count])
        count += 1
    return count, closest, least


@kernel
def wall_torque(held_wall: Held, held_scratch: Held, count: int) -> float:
    """Add up the torques of the ``count`` pairs found near; returns the energy stored in the wall [J]."""
    wall, scratch = held_wall.value, held_scratch.value
    depth, mobility, force = scratch.depth, scratch.mobility, scratch.force
    _factorise(scratch.M)
    total = 0.0
    for i in range(count):
        mobility[i] = _mobility(scratch.M, scratch.rows[i], scratch.row)
        total += wall.stiffness * mobility[i] * clamp(1.0 + depth[i] / _BAND, 0.0, 1.0)
    stiffness = wall.stiffness * min(1.0, _STIFFEST / max(total, _IMMOBILE))
    total = 0.0
    for i in range(count):
        # c = 2 xi sqrt(k m), thus c / m = 2 xi sqrt(k / m)
        share = clamp(depth[i] / _BAND, 0.0, 1.0)
        total += share * 2.0 * wall.damping_ratio * np.sqrt(stiffness * mobility[i])
    damping = 2.0 * wall.damping_ratio * min(1.0, _MOST_DAMPED / max(total, _IMMOBILE))
    scratch.tau[:] = 0.0
    energy = 0.0
    softest = wall.maximum_force / stiffness  # depth from which the force is constant
    for i in range(count):
        force[i] = 0.0
        x = depth[i]
        if x <= 0.0 or mobility[i] <= _IMMOBILE:
            continue
        rate = 0.0
        for j in range(scratch.v.shape[0]):
            rate += scratch.rows[i, j] * scratch.v[j]
        elastic = stiffness * min(x, softest)
        damped = damping * np.sqrt(stiffness / mobility[i]) * clamp(x / _BAND, 0.0, 1.0) * rate
        force[i] = clamp(elastic - damped, 0.0, wall.maximum_force)
        energy += elastic * (x - 0.5 * min(x, softest))
        for j in range(scratch.v.shape[0]):
            scratch.tau[j] += force[i] * scratch.rows[i, j]
    return energy


@lean_kernel
def _factorise(M: Array) -> None:
    """Cholesky factor of a symmetric M, read from its upper triangle, into the lower one and the diagonal."""
    for j in range(M.shape[0]):
        diagonal = M[j, j]
        for k in range(j):
            diagonal -= M[j, k] * M[j, k]
        M[j, j] = np.sqrt(diagonal)
        for i in range(j + 1, M.shape[0]):
            value = M[j, i]
            for k in range(j):
                value -= M[i, k] * M[j, k]
            M[i, j] = value / M[j, j]


@lean_kernel
def _mobility(factor: Array, row: Array, out: Array) -> float:
    """Inverse of the effective mass along ``row``, g' M^-1 g = |L^-1 g|^2 [1/kg]."""
    total = 0.0
    for i in range(row.shape[0]):
        value = row[i]
        for k in range(i):
            value -= factor[i, k] * out[k]
        out[i] = value / factor[i, i]
        total += out[i] * out[i]
    return total
