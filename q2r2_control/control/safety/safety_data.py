"""The state of the reference, and the arrays that the safety kernels write in each tick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel
from q2r2_control.control.geometry.kinematics import IntArray
from q2r2_control.control.kernel_pointers import KernelPointers, pointers_to
from q2r2_control.control.safety.joint_limits import JointLimits, VelocityBox
from q2r2_control.control.safety.reference_history import ReferenceHistory
from q2r2_control.control.safety.speed_bound import BodyVelocities
from q2r2_control.control.safety.tool_speed import ToolLimits, ToolSpeeds
from q2r2_control.types import Array

# A pair counts as too close if its distance is smaller than required by more than this, see stop_certificate.py.
ROUNDING = 1e-9  # [m]


class Approach(NamedTuple):
    """The rules by which pairs may approach each other in the QP."""

    stop_distance: Array  # (p,) Distance at which the QP stops a pair: min_distance plus buffer [m].
    gain: Array  # (1,) The gain of the rows, see separation_rows.py. It may change between ticks [1/s].
    contact_speed: Array  # (p,) Greatest speed in the contact zone of pairs that may touch; infinite for others [m/s].
    contact_zone: Array  # (p,) Free distance at which the contact zone begins; 0 for pairs that must not touch [m].
    recovery_speed: float  # Greatest speed at which a row asks a pair to open [m/s].


class SafetyModel(NamedTuple):
    """Data that do not change within a tick.

    Three things may change between ticks: the bodies of fingers, the kept distances and the gain.
    """

    collision: CollisionModel
    limits: JointLimits
    approach: Approach
    min_distance: Array  # (p,) Distance that every pair keeps [m]; minus infinity if the pair does not count now.
    arm: IntArray  # (nv,) Number of the arm of each joint. Joints outside of all arms share the last number.
    of_two_arms: IntArray  # (p,) 1 if both bodies move, and no joint moves both.
    tools: ToolLimits


_SAMPLES = 65  # Number of samples of a stop, with both ends.
# Indices of the samples of a stop for which the QP has rows: its start, about the middle of its path, and its end.
INSTANTS = (0, 20, 64)
# A pair has at most one row for the closest points and four rows for ends of segments at each instant. It may have one
# more row if one arm moves behind the other arm (following_rows.py).
_ROWS_PER_PAIR = 5 * len(INSTANTS) + 1


class ReferenceState(NamedTuple):
    """The state of the reference."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    a: Array  # (nv,) Mean acceleration in this tick [rad/s^2].


class SeparationRows(NamedTuple):
    """Rows ``matrix v >= lower`` of the QP. The first ``used[0]`` rows are valid."""

    matrix: Array  # (m, nv) Rows of unit norm.
    lower: Array  # (m,) [rad/s]
    pair: IntArray  # (m,) The pair of each row.
    used: IntArray  # (1,) Number of valid rows.
    ahead: Array  # (instants,) Buffer for the distance of one pair at each instant [m].


class Candidate(NamedTuple):
    """A state that the reference may take after the step, and a stop that begins in this state."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    deceleration: Array  # (nv,) Decelerations of the stop [rad/s^2].


class QuadraticPiece(NamedTuple):
    """The motion of the joints in an interval of time.

    Joint j moves by D_j(t) = rate t + change t^2 / 2. If the joint comes to rest in the interval, it is only known that
    D_j is between 0 and ``loose``.
    """

    rate: Array  # (nv,) [rad/s]
    change: Array  # (nv,) [rad/s^2]
    loose: Array  # (nv,) [rad]
    travel: Array  # (nv,) Total variation of D_j [rad].


class Rollout(NamedTuple):
    """The s samples of the candidate's stop, evenly spaced in time. stop_rollout.py computes them."""

    q: Array  # (s, nv)
    v: Array  # (s, nv)
    samples: KernelPointers  # (s,) CollisionData at each sample. They share the arrays of frame rotations and contact.
    known: Array  # (s,) 1 if the sample contains the poses of the bodies, 0 if they are not computed yet.
    step: QuadraticPiece  # The step from the reference to the candidate.
    stop: QuadraticPiece  # The motion of the joints from the candidate to rest.
    piece: QuadraticPiece  # The motion of the joints in a part of the stop.
    # (nv,) Bound on the deviation of each joint from motion along its present velocity: rho + kappa in speed_bound.py
    # [rad or m].
    deviation: Array

    @classmethod
    def empty(cls, model: CollisionModel) -> Rollout:
        nv = len(model.chain.parent) - 1
        first = CollisionData.empty(model)
        samples = [first]
        for _ in range(_SAMPLES - 1):
            sample = CollisionData.empty(model)
            placements = sample.placements._replace(rotation=first.placements.rotation)
            samples.append(sample._replace(placements=placements, contact=first.contact))
        return cls(
            q=np.zeros((_SAMPLES, nv)),
            v=np.zeros((_SAMPLES, nv)),
            samples=pointers_to(samples),
            known=np.zeros(_SAMPLES),
            step=QuadraticPiece(*np.zeros((4, nv))),
            stop=QuadraticPiece(*np.zeros((4, nv))),
            piece=QuadraticPiece(*np.zeros((4, nv))),
            deviation=np.zeros(nv),
        )


class ActiveBounds(NamedTuple):
    """The limits that limited the last step. The first ``used[0]`` entries are valid."""

    kind: IntArray  # (k,) POSITION, VELOCITY or ACCELERATION of a joint, SEPARATION of a pair, TOOL_SPEED of a tool.
    subject: IntArray  # (k,) Index of the joint, the pair or the tool.
    used: IntArray  # (1,) Number of valid entries.


class SafetyData(NamedTuple):
    """The state of the reference, and the results of the safety kernels."""

    state: ReferenceState
    collision: CollisionData  # Placements and contact at the reference.
    velocities: BodyVelocities
    distance: Array  # (p,) Distance of each pair, or a lower bound of it for pairs that are far apart [m].
    near: IntArray  # (p,) 1 if a row of the pair may bind.
    rows: SeparationRows
    box: VelocityBox
    wanted: Array  # (nv,) The solver's next velocities, clamped to the box [rad/s].
    braked: Array  # (nv,) The next velocities of the certified stop [rad/s].
    certified: Array  # (nv,) The decelerations of the certified stop [rad/s^2].
    candidate: Candidate
    rollout: Rollout
    active: ActiveBounds
    unproven: IntArray  # (1,) The pair for which the last certificate failed.
    history: ReferenceHistory
    tools: ToolSpeeds

    @classmethod
    def empty(cls, model: SafetyModel) -> SafetyData:
        pairs, nv = len(model.collision.pairs.first), len(model.limits.lower)
        rows, tools = _ROWS_PER_PAIR * pairs, len(model.tools.joint)
        return cls(
            state=ReferenceState(*np.zeros((3, nv))),
            collision=CollisionData.empty(model.collision),
            velocities=BodyVelocities.empty(model.collision),
            distance=np.zeros(pairs),
            near=np.zeros(pairs, dtype=np.int64),
            rows=SeparationRows(
                matrix=np.zeros((rows, nv)),
                lower=np.zeros(rows),
                pair=np.zeros(rows, dtype=np.int64),
                used=np.zeros(1, dtype=np.int64),
                ahead=np.zeros(len(INSTANTS)),
            ),
            box=VelocityBox.empty(nv),
            wanted=np.zeros(nv),
            braked=np.zeros(nv),
            certified=np.ones(nv),
            candidate=Candidate(*np.zeros((2, nv)), *np.ones((1, nv))),
            rollout=Rollout.empty(model.collision),
            active=ActiveBounds(*np.zeros((2, nv + rows + tools), dtype=np.int64), *np.zeros((1, 1), dtype=np.int64)),
            unproven=np.zeros(1, dtype=np.int64),
            history=ReferenceHistory.empty(model.collision, CollisionData.empty(model.collision)),
            tools=ToolSpeeds.empty(model.tools),
        )


def provable_distances(model: SafetyModel, data: SafetyData) -> Array:
    """Return d - S of every pair (p,) [m]: the known stop brings no pair closer than this (stop_certificate.py).

    This also holds for the postures at which delayed arms may still be, see arm_skew.py. ``data`` has to contain the
    distances at the present reference. From now on, a pair may be required to keep the returned distance: the known
    stop keeps it.
    """
    pairs, travel = model.collision.pairs, np.maximum(0.5 * data.state.v**2 / data.certified, data.history.travel)
    way = (pairs.reach * travel[pairs.joint - 1]).sum(axis=1)  # The reach is 0 for entries without a joint.
    return np.asarray(data.distance - way)
