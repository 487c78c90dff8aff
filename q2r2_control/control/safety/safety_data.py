"""The reference's state and the arrays that the safety kernels write anew at each tick."""

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

# A pair that is closer than its distance by less than this is not too close, see stop_certificate.py.
ROUNDING = 1e-9  # [m]


class Approach(NamedTuple):
    """How pairs may approach each other in the QP."""

    stop_distance: Array  # (p,) min_distance + buffer [m]
    gain: Array  # (1,), which may change between ticks, see separation_rows.py [1/s]
    contact_speed: Array  # (p,) of pairs that may touch, in the contact zone [m/s]; of the others infinite
    contact_zone: Array  # (p,) free distance from which on that holds [m]; of the others 0
    recovery_speed: float  # [m/s]


class SafetyModel(NamedTuple):
    """Data that do not change in a tick; between ticks bodies of fingers, kept distances and the rows' gain may."""

    collision: CollisionModel
    limits: JointLimits
    approach: Approach
    min_distance: Array  # (p,) of every pair [m]; minus infinity: it does not count now
    arm: IntArray  # (nv,) number of the arm that a joint belongs to; joints of none share the last number
    of_two_arms: IntArray  # (p,) 1: both bodies move, and no joint moves both
    tools: ToolLimits


_SAMPLES = 65  # of a stop, both ends among them
INSTANTS = (0, 20, 64)  # of 64, where a row looks at the stop: the start, half of the way, and the end
# The closest points and four segment ends at each, and one of an arm that follows another.
_ROWS_PER_PAIR = 5 * len(INSTANTS) + 1


class ReferenceState(NamedTuple):
    """The reference."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    a: Array  # (nv,) mean of this tick [rad/s^2]


class SeparationRows(NamedTuple):
    """Rows ``matrix v >= lower`` of the QP; the first ``used[0]`` are valid."""

    matrix: Array  # (m, nv)
    lower: Array  # (m,) [m/s]; of unit rows [rad/s]
    pair: IntArray  # (m,)
    used: IntArray  # (1,) number of valid rows
    ahead: Array  # (instants,) scratch: how far a pair is apart at each [m]


class Candidate(NamedTuple):
    """The state after a step that is being looked at, and the stop from there."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    deceleration: Array  # (nv,) of the stop [rad/s^2]


class QuadraticPiece(NamedTuple):
    """How the joints move in a piece of time: D_j(t) = rate t + change t^2 / 2, or anywhere from 0 to ``loose``."""

    rate: Array  # (nv,) [rad/s]
    change: Array  # (nv,) [rad/s^2]
    loose: Array  # (nv,) [rad]
    travel: Array  # (nv,) total variation [rad]


class Rollout(NamedTuple):
    """Scratch of the stop certificate: samples of a stop."""

    q: Array  # (s, nv)
    v: Array  # (s, nv)
    samples: KernelPointers  # (s,) CollisionData at each; rotations of joint frames and contact are shared scratch
    known: Array  # (s,) 1 where the sample's bodies are placed
    step: QuadraticPiece  # from the reference to the candidate
    stop: QuadraticPiece  # all of the candidate's stop
    piece: QuadraticPiece  # a part of it
    deviation: Array  # (nv,) most of each joint from straight on, see speed_bound.py [rad or m]

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
    """The limits that held the last step back; the first ``used[0]`` are valid."""

    kind: IntArray  # (k,) POSITION, VELOCITY or ACCELERATION of a joint, SEPARATION of a pair, TOOL_SPEED of a tool
    subject: IntArray  # (k,) index of the joint, the pair or the tool
    used: IntArray  # (1,)


class SafetyData(NamedTuple):
    """The reference's state and what is measured and decided about it."""

    state: ReferenceState
    collision: CollisionData  # at the reference
    velocities: BodyVelocities
    distance: Array  # (p,) of each pair, or a lower bound where it is far [m]
    near: IntArray  # (p,) 1 where a row may bind
    rows: SeparationRows
    box: VelocityBox
    wanted: Array  # (nv,) the solver's next velocities within the box [rad/s]
    braked: Array  # (nv,) next velocities of the certified stop [rad/s]
    certified: Array  # (nv,) decelerations of the certified stop [rad/s^2]
    candidate: Candidate
    rollout: Rollout
    active: ActiveBounds
    unproven: IntArray  # (1,) pair that the last certificate failed for
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
    """d - S of every pair (p,) [m]: the stop that is at hand brings it no closer than that (stop_certificate.py).

    Nor does what the arms may still be at, see arm_skew.py.

    Needs the distances at the reference as it is. A pair may be asked to keep as much from now on. Then the stop at
    hand is proven with that, as if it had always been so.
    """
    pairs, travel = model.collision.pairs, np.maximum(0.5 * data.state.v**2 / data.certified, data.history.travel)
    way = (pairs.reach * travel[pairs.joint - 1]).sum(axis=1)  # reach is 0 where there is no joint
    return np.asarray(data.distance - way)
