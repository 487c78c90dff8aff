"""Cells that tests of the controller's parts look at, as the arrays their kernels take, and distances along motions."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np

from q2r2_control.config.cell import Config, load_config
from q2r2_control.config.control import ControllerSettings
from q2r2_control.control.geometry.collision import (
    CollisionBodies,
    CollisionData,
    CollisionModel,
    Pairs,
    collision_model_of,
    update_placements,
)
from q2r2_control.control.geometry.pair_distance import at_least, measure
from q2r2_control.control.jit import kernel
from q2r2_control.control.kernel_model import KernelData, KernelModel, kernel_model_of
from q2r2_control.control.safety.speed_bound import update_body_velocities
from q2r2_control.robot.robot import Robot
from q2r2_control.types import Array

NAMES = ("dual_iiwa7", "dual_panda")


class CellArrays(NamedTuple):
    """A robot and the arrays that the collision kernels read of it."""

    robot: Robot
    collision: CollisionModel

    @property
    def bodies(self) -> CollisionBodies:
        return self.collision.bodies

    @property
    def pairs(self) -> Pairs:
        return self.collision.pairs


@cache
def cell(name: str) -> CellArrays:
    """One of ``NAMES``, loaded once."""
    robot = Robot.from_config(pandas() if name == "dual_panda" else load_config(f"config/{name}.yaml"))
    return arrays_of(robot)


def arrays_of(robot: Robot) -> CellArrays:
    return CellArrays(robot, collision_model_of(robot))


@cache
def kernel_model(name: str) -> KernelModel:
    """The data of the controller's kernels about one of ``NAMES``, with the default settings."""
    return kernel_model_of(cell(name).robot, ControllerSettings())


def kernel_data(name: str, q: Array, v: Array | None = None) -> KernelData:
    """The controller's data with bodies and joints at ``q`` (nv,) and as fast as ``v``, nothing else computed."""
    data = KernelData.empty(kernel_model(name))
    data.safety.state.q[:] = q
    data.safety.state.v[:] = 0.0 if v is None else v
    model, state = kernel_model(name).safety.collision, data.safety.state
    update_placements(model, data.safety.collision, state.q)
    update_body_velocities(model, data.safety.collision, state.v, data.safety.velocities)
    return data


def pandas() -> Config:
    """Two pandas with a table before them."""
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


def placed(cell: CellArrays, q: Array) -> CollisionData:
    """Joint frames and geometries in the world at ``q`` (nv,)."""
    data = CollisionData.empty(cell.collision)
    update_placements(cell.collision, data, q)
    return data


def distances(cell: CellArrays, motion: Array, exact_below: float = np.inf) -> Array:
    """Distance of every pair (s, p) [m] at every posture of ``motion`` (s, nv).

    Pairs that are clearly farther apart than ``exact_below`` get a lower bound instead, which saves most of the time.
    """
    out = np.zeros((len(motion), len(cell.pairs.first)))
    _measure_all(cell.collision, CollisionData.empty(cell.collision), motion, exact_below, out)
    return out


@kernel
def _measure_all(model: CollisionModel, data: CollisionData, motion: Array, exact_below: float, out: Array) -> None:
    for i in range(motion.shape[0]):
        update_placements(model, data, motion[i])
        for p in range(model.pairs.first.shape[0]):
            out[i, p] = at_least(model, data, p)
            if out[i, p] < exact_below:
                out[i, p] = measure(model, data, p)
