"""The arrays that the compiled kernels share: what a cell is, what its arms are asked to do, and scratch."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from q2r2_control.control.geometry.collision import Bodies, Contact, Pairs, Posed
from q2r2_control.control.geometry.kinematics import Chain, IntArray, Placements
from q2r2_control.control.safety.separation_rows import Approach, Rows
from q2r2_control.control.safety.stop_certificate import Rollout
from q2r2_control.control.safety.velocity_bounds import Pace
from q2r2_control.control.tasks.frame import Motion, Tools
from q2r2_control.control.tasks.manipulability import ManipulabilityScratch
from q2r2_control.control.tasks.priority import Priority
from q2r2_control.control.tasks.swivel import Swivels, SwivelScratch
from q2r2_control.types import Array


class Limits(NamedTuple):
    """Scalars of the settings that the kernels use."""

    longest_step: float  # [s]
    min_distance: float  # [m]
    return_speed: float  # [rad/s]
    contact_speed: float  # [m/s]
    full_at: float  # [m]
    posture_gain: float  # [1/s]
    posture_speed: float  # [rad/s]
    manipulability_gain: float  # [rad/s]; 0: off
    swivels: int  # 1: some arm has a swivel task


class Cell(NamedTuple):
    """What does not change between ticks."""

    chain: Chain
    bodies: Bodies
    pairs: Pairs
    tools: Tools
    motion: Motion
    approach: Approach
    limits: Limits
    priority: Priority
    swivels: Swivels
    pair_arm: Array  # (p, n) 1 where the pair slows arm n down when close
    lower: Array  # (nv,) position limits less the margin [rad]
    upper: Array
    velocity: Array  # (nv,) [rad/s]
    acceleration: Array  # (nv,) [rad/s^2]
    home: Array  # (nv,) [rad]


class Trial(NamedTuple):
    """Scratch of a pose that is being looked at."""

    rotation: Array  # (3, 3)
    translation: Array  # (3,)
    gram: Array  # (3, 3)
    correction: Array  # (3, 3)
    moved: Array  # (6,)


class Goals(NamedTuple):
    """What the arms are asked to do."""

    member: Array  # (n, nv) 1 where a joint is the arm's
    smoothing: Array  # (3,) time of the feed-forward [s], and the tool speeds [m/s, rad/s] above which there is none
    follows: IntArray  # (n,) 1: the tool follows its goal, 0: the arm's joints hold
    rotation: Array  # (n, 3, 3)
    translation: Array  # (n, 3) [m]
    feed_forward: Array  # (n, 6) the goal's own twist [m/s, rad/s]
    hold: Array  # (nv,) joint positions to hold [rad]
    posture: Array  # (nv,) joint positions that the arms take where the tools leave them free to [rad]
    latched: IntArray  # (n,) 1: the arm has come to rest where it holds
    offered: IntArray  # (n,) what this tick brought: nothing, a pose, something else
    pose: Array  # (n, 4, 4) homogeneous, as offered
    trial: Trial

    @classmethod
    def empty(cls, cell: Cell, smoothing: Array) -> Goals:
        n, nv = len(cell.tools.joint), len(cell.home)
        return cls(
            member=cell.tools.member,
            smoothing=smoothing,
            follows=np.zeros(n, dtype=np.int64),
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            feed_forward=np.zeros((n, 6)),
            hold=np.zeros(nv),
            posture=cell.home.copy(),
            latched=np.zeros(n, dtype=np.int64),
            offered=np.zeros(n, dtype=np.int64),
            pose=np.zeros((n, 4, 4)),
            trial=Trial(np.zeros((3, 3)), np.zeros(3), np.zeros((3, 3)), np.zeros((3, 3)), np.zeros(6)),
        )


class Active(NamedTuple):
    """Bounds that the last step met."""

    code: IntArray  # (k,) 4 joint + kind of limit, or -1 - pair
    used: IntArray  # (1,) number of valid codes


class Workspace(NamedTuple):
    """The reference's state and arrays written anew each tick."""

    q: Array  # (nv,) [rad]
    v: Array  # (nv,) [rad/s]
    a: Array  # (nv,) mean of this tick [rad/s^2]
    placements: Placements
    posed: Posed
    pace: Pace
    contact: Contact
    rows: Rows
    distance: Array  # (p,) [m]
    rotation: Array  # (n, 3, 3) tool poses
    translation: Array  # (n, 3)
    J: Array  # (6 n, nv)
    twist: Array  # (n, 6)
    feedback: Array  # (6,)
    posture: Array  # (nv,)
    manipulability: ManipulabilityScratch
    swivel: SwivelScratch
    H: Array  # (nv, nv)
    g: Array  # (nv,)
    box_lower: Array  # (nv,)
    box_upper: Array  # (nv,)
    binding: IntArray  # (nv, 2) which limit makes each side of the box
    wanted: Array  # (nv,)
    candidate: Array  # (3, nv) velocities, positions, full braking
    deceleration: Array  # (2, nv) of the certified stop, and of the candidate's [rad/s^2]
    active: Active
    rollout: Rollout

    @classmethod
    def empty(cls, cell: Cell) -> Workspace:
        n, nv = len(cell.tools.joint), len(cell.home)
        return cls(
            q=np.zeros(nv),
            v=np.zeros(nv),
            a=np.zeros(nv),
            placements=Placements.empty(cell.chain),
            posed=Posed.empty(cell.bodies),
            pace=Pace.empty(cell.chain, cell.bodies),
            contact=Contact.empty(),
            rows=Rows.empty(len(cell.pairs.first), nv),
            distance=np.zeros(len(cell.pairs.first)),
            rotation=np.zeros((n, 3, 3)),
            translation=np.zeros((n, 3)),
            J=np.zeros((6 * n, nv)),
            twist=np.zeros((n, 6)),
            feedback=np.zeros(6),
            posture=np.zeros(nv),
            manipulability=ManipulabilityScratch.empty(nv),
            swivel=SwivelScratch.empty(n, nv),
            H=np.zeros((nv, nv)),
            g=np.zeros(nv),
            box_lower=np.zeros(nv),
            box_upper=np.zeros(nv),
            binding=np.zeros((nv, 2), dtype=np.int64),
            wanted=np.zeros(nv),
            candidate=np.zeros((3, nv)),
            deceleration=np.zeros((2, nv)),
            active=Active(np.zeros(nv + 5 * len(cell.pairs.first), dtype=np.int64), np.zeros(1, dtype=np.int64)),
            rollout=Rollout.empty(cell.chain, cell.bodies),
        )
