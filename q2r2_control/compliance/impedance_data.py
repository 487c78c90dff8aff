"""What the compiled law of the impedance knows and works on: see impedance_kernels.py."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.compliance.impedance_terms import BoolArray, PositionLimits, TermScratch
from q2r2_control.compliance.joint_dynamics import Dynamics, LinkInertias
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.tasks.task_model import Tools
from q2r2_control.types import Array


class ImpedanceModel(NamedTuple):
    """What does not change between ticks; k arms of at most m joints."""

    chain: Chain
    bodies: LinkInertias  # but for what grippers hold
    tools: Tools
    joints: IntArray  # (k, m) of each arm, the first ``dofs`` of a row
    dofs: IntArray  # (k,)
    torque_limit: Array  # (nv,) [Nm]
    limits: PositionLimits
    max_position_error: float  # [m]
    max_rotation_error: float  # [rad]
    consistent: bool  # which nullspace projector


class ToolState(NamedTuple):
    """One tool at one posture of all joints. World axes at its origin."""

    placements: Placements  # of the joint frames
    rotation: Array  # (3, 3)
    translation: Array  # (3,) [m]
    J: Array  # (6, nv)

    @classmethod
    def empty(cls, chain: Chain) -> ToolState:
        nv = len(chain.parent) - 1
        return cls(Placements.empty(chain), np.zeros((3, 3)), np.zeros(3), np.zeros((6, nv)))


class References(NamedTuple):
    """The newest reference, due at the end of its tick, and the one before, due now; kept between ticks."""

    due_q: Array  # (nv,) [rad]
    due_v: Array  # (nv,) [rad/s]
    a: Array  # (nv,) that leads to it [rad/s^2]
    wanted_q: Array  # (nv,)
    wanted_v: Array  # (nv,)


class ArmScratch(NamedTuple):
    """One arm of up to m joints."""

    J: Array  # (6 m,)
    M: Array  # (m^2,)
    springs: Array  # (m,) of the posture [Nm/rad]
    torque: Array  # (m,) of the posture [Nm]
    speed: Array  # (m,) that is wanted less the measured one [rad/s]
    stiffness: Array  # (6,) [N/m, Nm/rad]
    error_rate: Array  # (6,)
    acceleration: Array  # (6,) of the tool by the posture's torque
    turn: Array  # (3, 3)
    W: Array  # (nv, 7)
    mobility: Array  # (6, 6) J M^-1 J'
    inertia: Array  # (6, 6) of the tool
    terms: TermScratch

    @classmethod
    def empty(cls, joints: int, nv: int) -> ArmScratch:
        return cls(
            J=np.zeros(6 * joints),
            M=np.zeros(joints * joints),
            springs=np.zeros(joints),
            torque=np.zeros(joints),
            speed=np.zeros(joints),
            stiffness=np.zeros(6),
            error_rate=np.zeros(6),
            acceleration=np.zeros(6),
            turn=np.zeros((3, 3)),
            W=np.zeros((nv, 7)),
            mobility=np.zeros((6, 6)),
            inertia=np.zeros((6, 6)),
            terms=TermScratch.empty(joints),
        )


class ImpedanceData(NamedTuple):
    """One tick: what was measured, what is wanted, and what comes of it. World axes at the tools' origins."""

    inputs: Array  # (6, nv) as they come: measured q and v, the newest reference's q, v and a, torque to be added
    references: References
    usable_q: Array  # (nv,) the newest measured posture that was of use [rad]
    no_motion: Array  # (nv,) zeros
    springs: Array  # (k, 5) in force: the values of LIVE_IMPEDANCE [N/m, Nm/rad, 1, Nm/rad, 1]
    errors: Array  # (k, 6) after clipping [m, rad]
    clipped: IntArray  # (k,) 1 where it was longer
    repulsion: Array  # (nv,) from position limits [Nm]
    tau: Array  # (nv,) before bounds [Nm]
    bounded: Array  # (nv,) in: commanded last; out: what of tau is commanded now [Nm]
    saturated: BoolArray  # (nv,)
    rate_limited: BoolArray  # (nv,)
    dynamics: Dynamics
    factor: Array  # (nv, nv) of the inertia matrix, below the diagonal
    measured: ToolState  # scratch: of one tool at the measured posture
    wanted: ToolState  # scratch: at the one that is wanted
    arm: ArmScratch

    @classmethod
    def empty(cls, model: ImpedanceModel) -> ImpedanceData:
        arms, nv = len(model.dofs), len(model.limits.lower)
        return cls(
            inputs=np.zeros((6, nv)),
            references=References(*(np.zeros(nv) for _ in References._fields)),
            usable_q=np.zeros(nv),
            no_motion=np.zeros(nv),
            springs=np.ones((arms, 5)),
            errors=np.zeros((arms, 6)),
            clipped=np.zeros(arms, dtype=np.int64),
            repulsion=np.zeros(nv),
            tau=np.zeros(nv),
            bounded=np.zeros(nv),
            saturated=np.zeros(nv, dtype=np.bool_),
            rate_limited=np.zeros(nv, dtype=np.bool_),
            dynamics=Dynamics.empty(model.chain),
            factor=np.eye(nv),
            measured=ToolState.empty(model.chain),
            wanted=ToolState.empty(model.chain),
            arm=ArmScratch.empty(model.joints.shape[1], nv),
        )
