"""Inertia matrix and inverse dynamics of a tree of one-axis joints, compiled; a test holds both to Pinocchio's.

All vectors are told in world axes at the world's origin, so that what a body carries is added to its parent's as it is:
twists and accelerations are linear then angular velocity of what is at the origin, wrenches force then moment about it.
Recursive Newton-Euler and composite rigid bodies: Featherstone, "Rigid Body Dynamics Algorithms", 2008, tables 5.1 and
6.2. One pass makes both, which share every body's inertia and every joint's axis.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
import pinocchio as pin

from q2r2_control.control.geometry.kinematics import Chain, Placements
from q2r2_control.control.jit import inlined_kernel, kernel
from q2r2_control.types import Array


class LinkInertias(NamedTuple):
    """What the joints move, in the frame of each; index 0 is the world. May change between ticks."""

    mass: Array  # (n,) [kg]
    centre: Array  # (n, 3) of mass [m]
    inertia: Array  # (n, 3, 3) about that [kg m^2]
    rotor: Array  # (nv,) what the joint's rotor is geared up [kg m^2]
    gravity: Array  # (3,) [m/s^2]

    @classmethod
    def of(cls, model: pin.Model) -> LinkInertias:
        """Those of a Pinocchio model."""
        n = model.njoints
        bodies = cls(
            mass=np.zeros(n),
            centre=np.zeros((n, 3)),
            inertia=np.zeros((n, 3, 3)),
            rotor=np.array(model.armature),
            gravity=np.array(model.gravity.linear),
        )
        for joint in range(1, n):
            bodies.put(joint, model.inertias[joint])
        return bodies

    def put(self, joint: int, inertia: pin.Inertia) -> None:
        """Let a joint move this."""
        self.mass[joint], self.centre[joint], self.inertia[joint] = inertia.mass, inertia.lever, inertia.inertia


class Dynamics(NamedTuple):
    """Written by :func:`inverse_dynamics`."""

    axis: Array  # (n, 6) twist of a joint that moves at 1
    twist: Array  # (n, 6)
    acceleration: Array  # (n, 6)
    wrench: Array  # (n, 6) on a body and all that it carries
    mass: Array  # (n,) of it and all that it carries [kg]
    moment: Array  # (n, 3) of that mass [kg m]
    inertia: Array  # (n, 3, 3) of that [kg m^2]
    column: Array  # (6,) scratch
    M: Array  # (nv, nv)
    tau: Array  # (nv,) [Nm]

    @classmethod
    def empty(cls, chain: Chain) -> Dynamics:
        n = len(chain.parent)
        return cls(
            axis=np.zeros((n, 6)),
            twist=np.zeros((n, 6)),
            acceleration=np.zeros((n, 6)),
            wrench=np.zeros((n, 6)),
            mass=np.zeros(n),
            moment=np.zeros((n, 3)),
            inertia=np.zeros((n, 3, 3)),
            column=np.zeros(6),
            M=np.eye(n - 1),
            tau=np.zeros(n - 1),
        )


@kernel
def inverse_dynamics(
    chain: Chain, bodies: LinkInertias, placements: Placements, v: Array, a: Array, out: Dynamics
) -> None:
    """``out.tau`` that moves joints placed at a posture, at ``v``, with ``a`` (nv,), against gravity; and ``out.M``."""
    for k in range(3):
        out.acceleration[0, k] = -bodies.gravity[k]
    for i in range(1, chain.parent.shape[0]):
        _move(chain, placements, i, v[i - 1], a[i - 1], out)
        _weigh(bodies, placements, i, out)
        _times_inertia(out, i, out.acceleration[i], out.wrench[i])
        _times_inertia(out, i, out.twist[i], out.column)
        wrench, twist, momentum = out.wrench[i], out.twist[i], out.column
        _add_cross(twist[3:6], momentum[0:3], wrench[0:3])
        _add_cross(twist[3:6], momentum[3:6], wrench[3:6])
        _add_cross(twist[0:3], momentum[0:3], wrench[3:6])
    out.M[:] = 0.0
    for i in range(chain.parent.shape[0] - 1, 0, -1):
        out.tau[i - 1] = _dot(out.axis[i], out.wrench[i]) + bodies.rotor[i - 1] * a[i - 1]
        _times_inertia(out, i, out.axis[i], out.column)
        j = i
        while j != 0:
            out.M[i - 1, j - 1] = _dot(out.axis[j], out.column)
            out.M[j - 1, i - 1] = out.M[i - 1, j - 1]
            j = chain.parent[j]
        out.M[i - 1, i - 1] += bodies.rotor[i - 1]
        if chain.parent[i] != 0:
            _load_parent(out, i, chain.parent[i])


@inlined_kernel
def _move(chain: Chain, placements: Placements, i: int, speed: float, acceleration: float, out: Dynamics) -> None:
    """Axis, twist and acceleration of joint ``i``, from its parent's."""
    parent, axis, twist = chain.parent[i], out.axis[i], out.twist[i]
    way, origin = placements.axis[i], placements.translation[i]
    for k in range(3):
        axis[k], axis[3 + k] = 0.0, way[k]
    if chain.prismatic[i] == 1:
        for k in range(3):
            axis[k], axis[3 + k] = way[k], 0.0
    else:
        _add_cross(origin, way, axis[0:3])
    for k in range(6):
        twist[k] = out.twist[parent, k] + speed * axis[k]
        out.column[k] = 0.0
    turned = out.column
    _add_cross(twist[3:6], axis[0:3], turned[0:3])
    _add_cross(twist[0:3], axis[3:6], turned[0:3])
    _add_cross(twist[3:6], axis[3:6], turned[3:6])
    for k in range(6):
        out.acceleration[i, k] = out.acceleration[parent, k] + acceleration * axis[k] + speed * turned[k]


@inlined_kernel
def _weigh(bodies: LinkInertias, placements: Placements, i: int, out: Dynamics) -> None:
    """Mass, its moment and inertia of body ``i`` by itself, about the world's origin."""
    R, mass, moment, inertia = placements.rotation[i], bodies.mass[i], out.moment[i], out.inertia[i]
    square = 0.0
    for row in range(3):
        at = placements.translation[i, row]
        for k in range(3):
            at += R[row, k] * bodies.centre[i, k]
        moment[row] = at
        square += at * at
    for row in range(3):
        for column in range(row + 1):
            turned = -mass * moment[row] * moment[column]
            for k in range(3):
                for m in range(3):
                    turned += R[row, k] * bodies.inertia[i, k, m] * R[column, m]
            inertia[row, column] = turned
            inertia[column, row] = turned
        inertia[row, row] += mass * square
    out.mass[i] = mass
    for k in range(3):
        moment[k] *= mass


@inlined_kernel
def _times_inertia(out: Dynamics, i: int, twist: Array, wrench: Array) -> None:
    """Momentum of what joint ``i`` carries by now, at ``twist``."""
    mass, moment, inertia = out.mass[i], out.moment[i], out.inertia[i]
    for k in range(3):
        wrench[k] = mass * twist[k]
        wrench[3 + k] = inertia[k, 0] * twist[3] + inertia[k, 1] * twist[4] + inertia[k, 2] * twist[5]
    _add_cross(twist[3:6], moment, wrench[0:3])
    _add_cross(moment, twist[0:3], wrench[3:6])


@inlined_kernel
def _load_parent(out: Dynamics, i: int, parent: int) -> None:
    out.mass[parent] += out.mass[i]
    for k in range(3):
        out.moment[parent, k] += out.moment[i, k]
        for m in range(3):
            out.inertia[parent, k, m] += out.inertia[i, k, m]
    for k in range(6):
        out.wrench[parent, k] += out.wrench[i, k]


@inlined_kernel
def _dot(twist: Array, wrench: Array) -> float:
    total = 0.0
    for k in range(6):
        total += twist[k] * wrench[k]
    return total


@inlined_kernel
def _add_cross(a: Array, b: Array, out: Array) -> None:
    """Add a x b, of three numbers each."""
    out[0] += a[1] * b[2] - a[2] * b[1]
    out[1] += a[2] * b[0] - a[0] * b[2]
    out[2] += a[0] * b[1] - a[1] * b[0]
