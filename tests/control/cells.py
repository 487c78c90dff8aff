"""Cells that tests of the controller's parts look at, as the arrays their kernels take, and distances along motions."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from q2r2_control.config import Config, load_config
from q2r2_control.control.geometry.collision import (
    Bodies,
    Contact,
    Pairs,
    Posed,
    at_least,
    bodies_of,
    measure,
    pairs_of,
    pose_bodies,
)
from q2r2_control.control.geometry.kinematics import Chain, Placements, chain_of, place
from q2r2_control.control.jit import kernel
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

NAMES = ("dual_iiwa7", "dual_iiwa14", "dual_panda")


class CellArrays(NamedTuple):
    """A robot and the arrays that the kernels read of it."""

    robot: Robot
    chain: Chain
    bodies: Bodies
    pairs: Pairs


@cache
def cell(name: str) -> CellArrays:
    """One of ``NAMES``, loaded once."""
    robot = Robot.from_config(_pandas() if name == "dual_panda" else load_config(f"config/{name}.yaml"))
    return arrays_of(robot)


def arrays_of(robot: Robot) -> CellArrays:
    chain, bodies = chain_of(robot.model), bodies_of(robot.collision_model)
    travel = np.maximum(np.abs(robot.position_lower), np.abs(robot.position_upper))
    return CellArrays(robot, chain, bodies, pairs_of(robot.collision_model, chain, bodies, travel))


def _pandas() -> Config:
    arms = {
        side: {
            "model": "example-robot-data:panda",
            "mount": {"position": [0.0, y, 0.0]},
            "home": [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785],
        }
        for side, y in (("left", 0.4), ("right", -0.4))
    }
    table = {"shape": "box", "size": [0.8, 1.6, 0.04], "position": [0.75, 0.0, 0.0]}
    return Config.model_validate({"name": "pandas", "arms": arms, "obstacles": {"table": table}})


def random_posture(robot: Robot, random: np.random.Generator) -> Array:
    """Joint positions anywhere within the limits (nv,)."""
    return random.uniform(robot.position_lower, robot.position_upper)


def placed(cell: CellArrays, q: Array) -> tuple[Placements, Posed]:
    """Joint frames and geometries in the world at ``q`` (nv,)."""
    placements, posed = Placements.empty(cell.chain), Posed.empty(cell.bodies)
    place(cell.chain, q, placements)
    pose_bodies(cell.bodies, placements, posed)
    return placements, posed


def distances(cell: CellArrays, motion: Array, exact_below: float = np.inf) -> Array:
    """Distance of every pair (s, p) [m] at every posture of ``motion`` (s, nv).

    Pairs that are clearly farther apart than ``exact_below`` get a lower bound instead, which saves most of the time.
    """
    out = np.zeros((len(motion), len(cell.pairs.first)))
    placements, posed = Placements.empty(cell.chain), Posed.empty(cell.bodies)
    _measure_all(cell.chain, cell.bodies, cell.pairs, motion, exact_below, placements, posed, Contact.empty(), out)
    return out


@kernel
def _measure_all(
    chain: Chain,
    bodies: Bodies,
    pairs: Pairs,
    motion: Array,
    exact_below: float,
    placements: Placements,
    posed: Posed,
    contact: Contact,
    out: Array,
) -> None:
    for i in range(motion.shape[0]):
        place(chain, motion[i], placements)
        pose_bodies(bodies, placements, posed)
        for p in range(pairs.first.shape[0]):
            first, second = pairs.first[p], pairs.second[p]
            out[i, p] = at_least(bodies, posed, first, second)
            if out[i, p] < exact_below:
                out[i, p] = measure(bodies, posed, first, second, posed.start[first], posed.end[first], contact)
