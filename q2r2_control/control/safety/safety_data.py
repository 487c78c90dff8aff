"""The reference's state and the arrays that the safety kernels write anew at each tick."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import CollisionData, CollisionModel, Contact
from q2r2_control.control.geometry.kinematics import IntArray, Placements
from q2r2_control.control.safety.joint_limits import VelocityBox
from q2r2_control.control.safety.safety_model import SafetyModel
from q2r2_control.control.safety.velocity_bounds import BodyVelocities
from q2r2_control.types import Array

_DEEPEST = 6  # halvings of the stop: 64 intervals
_ROWS_PER_PAIR = 5  # the closest points and four segment ends


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

    @classmethod
    def empty(cls, pairs: int, nv: int) -> SeparationRows:
        m = _ROWS_PER_PAIR * pairs
        return cls(np.zeros((m, nv)), np.zeros(m), np.zeros(m, dtype=np.int64), np.zeros(1, dtype=np.int64))


class Candidate(NamedTuple):
    """The state after a step that is being looked at, and the stop from there."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    deceleration: Array  # (nv,) of the stop [rad/s^2]

    @classmethod
    def empty(cls, nv: int) -> Candidate:
        return cls(np.zeros(nv), np.zeros(nv), np.ones(nv))


class Rollout(NamedTuple):
    """Scratch of the stop certificate: samples of the stop at up to 2^deepest + 1 instants."""

    q: Array  # (s, nv)
    v: Array  # (nv,)
    start: Array  # (s, g, 3)
    end: Array  # (s, g, 3)
    rotation: Array  # (s, g, 3, 3)
    distance: Array  # (s,)
    known: Array  # (s,) 1 where the sample's bodies are placed
    step_travel: Array  # (nv,) of each joint during the step [rad]
    stop_travel: Array  # (nv,) during the stop [rad]
    placements: Placements
    contact: Contact

    @classmethod
    def empty(cls, model: CollisionModel) -> Rollout:
        samples, nv, g = 2**_DEEPEST + 1, len(model.chain.parent) - 1, len(model.bodies.joint)
        return cls(
            q=np.zeros((samples, nv)),
            v=np.zeros(nv),
            start=np.zeros((samples, g, 3)),
            end=np.zeros((samples, g, 3)),
            rotation=np.zeros((samples, g, 3, 3)),
            distance=np.zeros(samples),
            known=np.zeros(samples),
            step_travel=np.zeros(nv),
            stop_travel=np.zeros(nv),
            placements=Placements.empty(model.chain),
            contact=Contact.empty(),
        )


class ActiveBounds(NamedTuple):
    """What held the last step back; the first ``used[0]`` are valid."""

    kind: IntArray  # (k,) POSITION, VELOCITY or ACCELERATION of a joint, or SEPARATION of a pair
    subject: IntArray  # (k,) index of the joint or the pair
    used: IntArray  # (1,)

    @classmethod
    def empty(cls, pairs: int, nv: int) -> ActiveBounds:
        k = nv + _ROWS_PER_PAIR * pairs
        return cls(np.zeros(k, dtype=np.int64), np.zeros(k, dtype=np.int64), np.zeros(1, dtype=np.int64))


class SafetyData(NamedTuple):
    """The reference's state and what is measured and decided about it."""

    state: ReferenceState
    collision: CollisionData  # at the reference
    velocities: BodyVelocities
    distance: Array  # (p,) of each pair, or a lower bound where it is far [m]
    rows: SeparationRows
    box: VelocityBox
    wanted: Array  # (nv,) the solver's next velocities within the box [rad/s]
    braked: Array  # (nv,) next velocities of the certified stop [rad/s]
    certified_deceleration: Array  # (nv,) of the certified stop [rad/s^2]
    candidate: Candidate
    rollout: Rollout
    active: ActiveBounds

    @classmethod
    def empty(cls, model: SafetyModel) -> SafetyData:
        pairs, nv = len(model.collision.pairs.first), len(model.limits.lower)
        return cls(
            state=ReferenceState(np.zeros(nv), np.zeros(nv), np.zeros(nv)),
            collision=CollisionData.empty(model.collision),
            velocities=BodyVelocities.empty(model.collision),
            distance=np.zeros(pairs),
            rows=SeparationRows.empty(pairs, nv),
            box=VelocityBox.empty(nv),
            wanted=np.zeros(nv),
            braked=np.zeros(nv),
            certified_deceleration=np.ones(nv),
            candidate=Candidate.empty(nv),
            rollout=Rollout.empty(model.collision),
            active=ActiveBounds.empty(pairs, nv),
        )
